"""What every page that facerf writes begins and ends with; a page is one file and fetches nothing."""

from collections.abc import Iterable
from html import escape


def html_page(title: str, style: str, body: Iterable[str]) -> str:
    """A page of lines that are markup already; `title` is text, `style` CSS."""
    head = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{style}</style>\n</head>\n<body>"
    )
    return "\n".join([head, *body, "</body>\n</html>\n"])
