"""The report of a prepared dataset: a contact sheet a subject, and an HTML page of all subjects.

The page shows every subject's sheet, split, fit and findings; it is plain HTML without scripts.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from html import escape
from typing import Any

import numpy as np

from facerf_cli.colour import auto_exposure_ev
from facerf_cli.face.crop import Crop
from facerf_cli.face.drawings import draw_fit
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.files.drawings import html_page, mark_light
from facerf_cli.files.olat_stack import StackHeader
from facerf_cli.light.sphere import azel_to_direction

_STYLE = """
body { font: 15px/1.5 sans-serif; margin: 2em; background: #181818; color: #ddd }
a { color: #8bf } h2 { margin: 2em 0 0 } p { margin: .2em 0 } img { max-width: 100%; margin-top: .5em }
table { border-spacing: 1.2em 0; margin-left: -1.2em } td, th { text-align: left }
img.chart { max-width: 24em }
.fair { color: #fc6 } .poor, .failed { color: #f66 }
"""
_COLUMNS = (
    "A row of a sheet is a camera: the crop under all lights, the fit over it (green: detected landmarks, or "
    "the fit's where no face was detected; orange: the fit's), the masked crop, and a light in front, on the "
    "left and on the right."
)
_TILE_PX = 192
_SHEET_AZEL_DEG = ((0.0, 15.0), (-60.0, 20.0), (60.0, 20.0))  # front, left and right, in camera space

FindingRows = Sequence[Mapping[str, Any]]


def index_page(
    dataset: Mapping[str, Any], records: Mapping[str, Mapping[str, Any]], findings: Mapping[str, FindingRows]
) -> str:
    """Make the page from the content of `dataset.json`, the records of finished subjects and the findings."""
    title = f"{dataset['capture']}: {len(records)} of {len(dataset['subjects'])} subjects"
    return html_page(title, _STYLE, _lines(title, dataset, records, findings))


def _lines(
    title: str,
    dataset: Mapping[str, Any],
    records: Mapping[str, Mapping[str, Any]],
    findings: Mapping[str, FindingRows],
) -> Iterator[str]:
    yield f"<h1>{escape(title)}</h1>"
    split_of = {name: split for split, names in dataset["splits"].items() for name in names}
    counts = ", ".join(f"{len(names)} {split}" for split, names in dataset["splits"].items())
    lights, cameras = (len(entries) for entries in (dataset["rig"]["lights"], dataset["cameras"]))
    yield f"<p>Subjects: {counts}. Lights: {lights}. Cameras: {cameras}.</p>"
    for chart in dataset["normalisation"].get("colour_charts", ()):
        yield from _colour_chart(chart)
    yield f"<p>{escape(_COLUMNS)}</p>"
    for subject in dataset["subjects"]:
        yield from _subject(subject, split_of.get(subject, "in no split"), records.get(subject))
        yield from _findings(findings.get(subject, ()))


def _colour_chart(chart: Mapping[str, Any]) -> Iterator[str]:
    """Colour error before and after a colour chart's correction, and the chart's image."""
    before, after = (chart["delta_e_2000"][when]["mean"] for when in ("before", "after"))
    words = (
        f"Colour chart of {', '.join(chart['cameras'])}: CIE delta E 2000 {after:.1f}, before {before:.1f}"
    )
    file = escape(chart["overlay"])
    yield f'<p>{escape(words)}</p>\n<a href="{file}"><img class="chart" src="{file}" alt="colour chart"></a>'


def _findings(rows: FindingRows) -> Iterator[str]:
    """Table of a subject's findings."""
    if not rows:
        return
    yield "<table>\n<tr><th>finding</th><th>where</th><th></th></tr>"
    for row in rows:
        place = "/".join(str(row[key]) for key in ("camera", "light") if row.get(key))
        kind = "poor" if row.get("severity") == "error" else "fair"
        cells = [f"<td>{escape(str(text))}</td>" for text in (row.get("check"), place, row.get("words"))]
        yield f'<tr class="{kind}">{"".join(cells)}</tr>'
    yield "</table>"


def _subject(subject: str, split: str, record: Mapping[str, Any] | None) -> Iterator[str]:
    name = escape(subject)
    yield f'<h2 id="{name}">{name}</h2>'
    if record is None:
        yield '<p class="failed">failed; see report.jsonl</p>'
        return
    yield f"<p>{escape(split)}</p>"
    for key, words in (("left_out", "lights"), ("dropped", "cameras")):
        if reasons := record.get(key):
            text = "; ".join(f"{name} ({why})" for name, why in reasons.items())
            yield f'<p class="fair">left out of the {words}: {escape(text)}</p>'
    yield "<table>\n<tr><th>camera</th><th>error, % of the eyes' distance</th></tr>"
    for camera, fit in record["cameras"].items():
        stack = f'<a href="olat/{name}/{escape(camera)}.exr">{escape(camera)}</a>'
        found = f"{100 * fit['error_iod']:.1f} {fit['quality']}" if fit["face_found"] else "no face found"
        kind = fit["quality"] if fit["face_found"] else "fair"
        yield f'<tr><td>{stack}</td><td class="{kind}">{found}</td></tr>'
    sheet = f"sheets/{name}.jpg"
    yield f'</table>\n<a href="{sheet}"><img loading="lazy" src="{sheet}" alt="{name}"></a>'


def sheet_lights(directions: np.ndarray) -> list[int]:
    """Indices of the sheet's three lights: those nearest to front, left and right; directions [L, 3]."""
    wanted = np.stack([azel_to_direction(*azel).numpy() for azel in _SHEET_AZEL_DEG])
    return (wanted @ directions.T).argmax(1).tolist()


def sheet_tiles(
    header: StackHeader, fit: FaceFit, model: MorphableModel, shown: Mapping[int, np.ndarray]
) -> np.ndarray:
    """Tiles of one camera [6, h, w, 3]: fully lit, the fit over it, masked, and three single lights.

    Scene-linear, exposed for display; the three lights share one exposure.
    """
    side_px = fit.crop.size_px
    lit = header.source * np.float32(2 ** auto_exposure_ev(header.source))
    overlay = draw_fit(header.source, replace(fit, crop=Crop(0.0, 0.0, float(side_px), side_px)), model)
    masked = lit * (0.1 + 0.9 * header.seen[..., None])
    single = np.stack([shown[light] for light in sheet_lights(header.directions)])
    single *= np.float32(2 ** auto_exposure_ev(single.reshape(-1, side_px, 3)))
    small = Crop(0.0, 0.0, float(side_px), min(side_px, _TILE_PX))
    tiles = np.stack([small.apply(tile.clip(0, 1)) for tile in (lit, overlay, masked, *single)])
    for tile, light in zip(tiles[3:], sheet_lights(header.directions), strict=True):
        mark_light(tile, header.directions[light], 1.0)
    return tiles
