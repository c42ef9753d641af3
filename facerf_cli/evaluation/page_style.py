"""How the report looks: on a desk, on a telephone, at night and on paper; no scripts, nothing fetched."""

from facerf_cli.evaluation.strips import ERROR_COLOURS

# Okabe and Ito's colours (2008), told apart by colour-blind readers; the methods' in their order.
METHOD_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b8860b", "#3a9fd8", "#8a8a8a")
_GRADIENT = ", ".join(f"rgb({r} {g} {b})" for r, g, b in ERROR_COLOURS)

STYLE = (
    """
:root { color-scheme: light dark; --paper: #fff; --ink: #1b1e23; --soft: #5a626d; --line: #d9dde3;
  --band: #f4f6f8; --link: #0a5ea8; --mark: #7a4b00; --marked: #fff6e3 }
@media (prefers-color-scheme: dark) { :root { --paper: #15181c; --ink: #e6e8eb; --soft: #a3abb6;
  --line: #363c45; --band: #1e2228; --link: #7dbdf5; --mark: #f0c674; --marked: #2c2616 } }
* { box-sizing: border-box }
body { margin: 0 auto; padding: 2rem 1.25rem 4rem; max-width: 80rem; background: var(--paper);
  color: var(--ink); font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0 0 .25rem }
h2 { font-size: 1.25rem; margin: 2.75rem 0 .5rem; padding-top: .75rem; border-top: 1px solid var(--line) }
h3 { font-size: 1rem; margin: 1.75rem 0 .4rem }
p { margin: .4rem 0; max-width: 46rem } a { color: var(--link) }
.lead { color: var(--soft); font-size: 1.05rem }
.soft, caption, figcaption { color: var(--soft); font-size: .875rem }
pre { background: var(--band); border: 1px solid var(--line); border-radius: 6px; padding: .6rem .8rem;
  overflow-x: auto; white-space: pre-wrap; overflow-wrap: anywhere; font-size: .85rem; margin: .75rem 0 }
nav ul { list-style: none; display: flex; flex-wrap: wrap; gap: .25rem 1.25rem; padding: 0; margin: 1rem 0 0 }
.scroll { overflow-x: auto; margin: .5rem 0 1rem }
table { border-collapse: collapse; font-size: .85rem; font-variant-numeric: tabular-nums; width: 100% }
caption { text-align: left; padding: 0 0 .4rem }
th, td { padding: .3rem .55rem; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line) }
thead th { color: var(--soft); font-weight: 600; border-bottom: 2px solid var(--line) }
th:first-child, td:first-child, th.text, td.text { text-align: left }
tbody th { font-weight: 600 } tbody.group th { border-bottom-color: transparent }
tr.published td, tr.published th { background: var(--marked); color: var(--mark); font-weight: 400 }
td.data { text-align: left; white-space: normal }
td.chart { width: 22%; min-width: 8.5rem; padding: 0 .7rem }
td.chart svg { display: block; width: 100%; height: 1.6rem; overflow: visible }
.dot { display: inline-block; width: .7em; height: .7em; border-radius: 50%; margin-right: .5em }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1rem; margin: .75rem 0;
  font-size: .9rem }
dt { color: var(--soft) } dd { margin: 0; overflow-wrap: anywhere }
article { margin: 1.5rem 0 2.25rem; break-inside: avoid }
article h3 { margin: 0 0 .1rem; overflow-wrap: anywhere }
figure { margin: .5rem 0 }
.columns { display: grid; gap: 0; font-size: .8rem; line-height: 1.3; margin-bottom: .3rem }
.columns > div { padding-right: .5rem; overflow-wrap: anywhere } .columns b { display: block }
.strip img { display: block; width: 100%; height: auto }
.scale { display: flex; align-items: center; gap: .6rem; font-size: .875rem; color: var(--soft) }
.scale i { width: 10rem; height: .8rem; border-radius: 2px; background: linear-gradient(to right, """
    + _GRADIENT
    + """) }
summary { cursor: pointer; font-weight: 600; padding: .3rem 0 }
a:focus-visible, summary:focus-visible, .scroll:focus-visible { outline: 3px solid var(--link) }
@media (max-width: 40rem) { body { padding: 1.25rem .9rem 3rem } h1 { font-size: 1.4rem }
  dl { grid-template-columns: 1fr; gap: 0 } dd { margin-bottom: .4rem } }
@media print { :root { --paper: #fff; --ink: #000; --soft: #444; --line: #bbb; --band: #fff; --marked: #fff }
  body { max-width: none; padding: 0; font-size: 10pt } nav { display: none } .scroll { overflow: visible }
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact } }
"""
)
