"""HTML pages in one file: headings, sentences, tables and pictures; all text is escaped."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING

from simbias.pictures.elements.style import PUBLISHED_DOTS_PER_INCH, png

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"  # nothing is loaded, nothing runs
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222;
  max-width: 68rem; margin: 2rem auto; padding: 0 1rem }
table { border-collapse: collapse; margin: 1rem 0; font-size: 0.9rem; display: block; overflow-x: auto }
th, td { border-bottom: 1px solid #ddd; padding: 0.25rem 0.5rem; text-align: right; white-space: nowrap }
th { white-space: normal; vertical-align: bottom }
th:first-child, td:first-child, td:last-child, th:last-child { text-align: left }
td:last-child { white-space: normal }
img { max-width: 100%; height: auto }
pre { font-size: 0.85rem; overflow-x: auto; background: #f6f6f6; padding: 0.7rem }
@media print, (max-width: 50rem) {
  table { font-size: 0.7rem }
  th, td { white-space: normal; padding: 0.2rem 0.3rem }
}
@media print {
  body { font-size: 10pt; margin: 0 }
  table, pre { overflow: visible }
  pre { white-space: pre-wrap }
  tr, img { break-inside: avoid }
  h2 { break-after: avoid }
}
"""


def page(title: str, parts: Iterable[str]) -> str:
    """A whole page, from parts made by the functions below."""
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        f"<h1>{escape(title)}</h1>\n" + "\n".join(parts) + "\n</body>\n</html>\n"
    )


def heading(words: str) -> str:
    """A heading below the title."""
    return f"<h2>{escape(words)}</h2>"


def paragraph(words: str) -> str:
    """A paragraph."""
    return f"<p>{escape(words)}</p>"


def items(lines: Iterable[str]) -> str:
    """A list."""
    return "<ul>\n" + "\n".join(f"<li>{escape(line)}</li>" for line in lines) + "\n</ul>"


def table(names: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table with a header of names."""
    head = "".join(f"<th>{escape(name)}</th>" for name in names)
    body = "\n".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table>"


def picture(figure: Figure, words: str) -> str:
    """A figure within the page; the words are its alternative text."""
    return image(png(figure, PUBLISHED_DOTS_PER_INCH, optimize=True), words)


def image(file: bytes, words: str) -> str:
    """A PNG file within the page."""
    return f'<p><img alt="{escape(words)}" src="data:image/png;base64,{b64encode(file).decode()}"></p>'


def preformatted(text: str) -> str:
    """Preformatted text."""
    return f"<pre>{escape(text)}</pre>"
