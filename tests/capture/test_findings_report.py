"""The table of findings: errors first, alike ones put together, nothing where there is nothing."""

import io

from rich.console import Console

from facerf_cli.capture.findings import Finding, show_findings, summary

STOPS = Finding("error", "rig", "0001", "the lights\nare mirrored [left] to right", "C0")
WARNS = Finding("warning", "motion", "0000", "the head moves", "C0")
FIELDS = [Finding("error", "fields", "0000", f"has {k} fields", "C0", f"L{k:03d}") for k in range(9)]


def shown(findings: list[Finding], width: int = 200, strict: bool = False) -> str:
    console = Console(file=io.StringIO(), width=width)
    show_findings(findings, strict, console)
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_a_report_counts_what_is_alike_and_begins_with_what_stops_a_subject() -> None:
    assert shown([]) == ""
    text = shown([WARNS, *FIELDS, STOPS])
    assert text.index("subject stopped", text.index("0001/C0")) < text.index("0000/C0/L000")
    assert text.index("0000/C0/L002") < text.index("the head moves")
    assert "are mirrored [left] to right" in text  # brackets are no markup
    assert "the lights are mirrored [left] to right" in shown([STOPS], width=60)
    assert "warning" not in shown([WARNS, *FIELDS, STOPS], strict=True)
    assert "left out" not in shown(FIELDS, strict=True)
    text = shown(FIELDS)
    assert "0000/C0/L002" in text and "L003" not in text and "(and 6 more like it)" in text
    assert (
        summary([WARNS, *FIELDS, STOPS])
        == "Findings about 2 subjects: 1 x subject stopped, 9 x frame left out, 1 x warning"
    )
