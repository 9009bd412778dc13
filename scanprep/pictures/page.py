"""A report as one HTML file that needs nothing else."""
from __future__ import annotations

import base64
import io
import mimetypes
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry.storage import writing
from .sheets import png_bytes

_STYLE = """
:root { color-scheme: light dark; --paper: #ffffff; --ink: #24282d; --soft: #667078; --line: #e2e5e8;
  --tint: #f5f6f7; --link: #1d5f9e; }
@media (prefers-color-scheme: dark) { :root { --paper: #16191c; --ink: #e4e7ea; --soft: #98a2ab; --line: #31373d;
  --tint: #1e2226; --link: #7db8ee; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); line-height: 1.55;
  font: 17px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
main { max-width: 62rem; margin: 0 auto; padding: 3.5rem 1.25rem 5rem; }
h1 { font-size: clamp(1.9rem, 5vw, 2.7rem); line-height: 1.12; letter-spacing: -0.02em; margin: 0 0 .6rem; }
h2 { font-size: 1.4rem; letter-spacing: -0.01em; margin: 3.2rem 0 .4rem; padding-top: 1.1rem;
  border-top: 1px solid var(--line); }
p { max-width: 42rem; margin: .4rem 0 1rem; }
.lead { font-size: 1.15rem; color: var(--soft); }
figure { margin: 1.2rem 0; }
.row { display: grid; gap: 1rem; grid-template-columns: repeat(auto-fit, minmax(min(100%, 13rem), 1fr)); }
.row figure { margin: 0; }
img, svg { display: block; max-width: 100%; height: auto; margin: 0 auto; }
figure > img, figure > svg { background: #fff; border: 1px solid var(--line); border-radius: 10px; }
figcaption { color: var(--soft); font-size: .92rem; margin: .45rem auto 0; max-width: 42rem; text-align: center; }
.scroll { overflow-x: auto; margin: 1.2rem 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .96rem; }
th { text-align: left; font-weight: 600; color: var(--soft); border-bottom: 2px solid var(--line); }
th, td { padding: .42rem 1.1rem .42rem 0; vertical-align: baseline; }
td { border-bottom: 1px solid var(--line); }
.number { text-align: right; }
nav { display: flex; flex-wrap: wrap; gap: .3rem 1.2rem; margin: 1.6rem 0 0; font-size: .95rem; }
a { color: var(--link); text-decoration: none; } a:hover { text-decoration: underline; }
.file { display: inline-block; margin: .2rem .8rem .8rem 0; padding: .5rem .9rem; border: 1px solid var(--line);
  border-radius: 8px; background: var(--tint); }
.file small { color: var(--soft); margin-left: .5rem; }
pre { background: var(--tint); border: 1px solid var(--line); border-radius: 8px; padding: .8rem 1rem;
  overflow-x: auto; font-size: .88rem; }
@media print { main { padding: 0; } figure, table { break-inside: avoid; } }
"""


class Page:
    """A page built from top to bottom; every method returns the page, so that calls can be chained."""

    def __init__(self, title: str, lead: str = "") -> None:
        self.title, self.lead = title, lead
        self._parts: list[str] = []
        self._styles: list[str] = []
        self._sections: list[str] = []

    def section(self, title: str, text: str = "") -> Page:
        """A heading and a paragraph below it."""
        self._sections.append(title)
        self._parts.append(f'<h2 id="s{len(self._sections)}">{escape(title)}</h2>')
        return self.text(text) if text else self

    def text(self, text: str) -> Page:
        """Paragraphs, separated by empty lines."""
        self._parts += [f"<p>{escape(block.strip())}</p>" for block in text.split("\n\n") if block.strip()]
        return self

    def code(self, text: str) -> Page:
        """Text in a typewriter face, as it stands: commands, settings."""
        self._parts.append(f"<pre><code>{escape(text.strip())}</code></pre>")
        return self

    def markup(self, html: str, style: str = "") -> Page:
        """HTML as it stands, for what the other methods cannot show, and the CSS rules it needs, once each."""
        self._parts.append(html)
        if style and style not in self._styles:
            self._styles.append(style)
        return self

    def picture(self, image: np.ndarray | bytes, caption: str = "", alt: str = "") -> Page:
        """A picture."""
        self._parts.append(_figure(image, caption, alt))
        return self

    def pictures(self, images: Sequence[np.ndarray | bytes], captions: Sequence[str] = ()) -> Page:
        """Pictures in a row that wraps on narrow screens."""
        if captions and len(captions) != len(images):
            raise ValueError(f"captions: expected {len(images)}, one for each image, got {len(captions)}")
        figures = [_figure(image, caption, "") for image, caption in
                   zip(images, captions or [""] * len(images), strict=True)]
        self._parts.append(f'<div class="row">{"".join(figures)}</div>')
        return self

    def table(self, rows: Iterable[Sequence[Any]], header: Sequence[str] = ()) -> Page:
        """A table; numbers are set flush right, floats with three significant figures."""
        head = "".join(f"<th>{escape(name)}</th>" for name in header)
        body = "".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in rows)
        head = f"<thead><tr>{head}</tr></thead>" if head else ""
        self._parts.append(f'<div class="scroll"><table>{head}<tbody>{body}</tbody></table></div>')
        return self

    def chart(self, figure: Any, caption: str = "", alt: str = "") -> Page:
        """A matplotlib figure, as vector graphics; the same figure gives the same bytes."""
        from matplotlib import rc_context

        out = io.BytesIO()
        with rc_context({"svg.hashsalt": "scapekit"}):
            figure.savefig(out, format="svg", bbox_inches="tight", metadata={"Date": None})
        return self.picture(out.getvalue(), caption, alt)

    def download(self, name: str, data: bytes, text: str = "") -> Page:
        """A link that saves a file carried by the page itself."""
        kind = "model/gltf-binary" if name.endswith(".glb") else mimetypes.guess_type(name)[0]
        size = f"{len(data) / 1e6:.1f} MB" if len(data) >= 1e5 else f"{len(data) / 1e3:.1f} kB"
        self._parts.append(f'<a class="file" download="{escape(name)}" href="{_data_uri(data, kind)}">'
                           f"{escape(text or name)}<small>{size}</small></a>")
        return self

    def html(self) -> str:
        """The whole page."""
        lead = f'<p class="lead">{escape(self.lead)}</p>' if self.lead else ""
        links = "".join(f'<a href="#s{i + 1}">{escape(s)}</a>' for i, s in enumerate(self._sections))
        nav = f'<nav aria-label="Contents">{links}</nav>' if len(self._sections) > 2 else ""
        return (f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
                f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
                f"<title>{escape(self.title)}</title>\n<style>{_STYLE}{''.join(self._styles)}</style>\n</head>\n<body>\n<main>\n"
                f"<header><h1>{escape(self.title)}</h1>{lead}{nav}</header>\n"
                + "\n".join(self._parts) + "\n</main>\n</body>\n</html>\n")

    def write(self, path: str | Path) -> None:
        """Write the page, whole or not at all."""
        with writing(path) as beside:
            beside.write_text(self.html(), encoding="utf-8")


def _figure(image: np.ndarray | bytes, caption: str, alt: str) -> str:
    data = image if isinstance(image, bytes) else png_bytes(image)
    below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    source = data_uri(data)
    size = "" if isinstance(image, bytes) else f' width="{image.shape[1]}" height="{image.shape[0]}"'
    return f'<figure><img src="{source}" alt="{escape(alt or caption or "picture")}"{size}>{below}</figure>'


def _image_kind(data: bytes) -> str:
    signatures = {b"\x89PNG": "image/png", b"GIF8": "image/gif", b"\xff\xd8\xff": "image/jpeg",
                  b"RIFF": "image/webp"}
    kind = next((kind for start, kind in signatures.items() if data.startswith(start)), None)
    if kind is None and b"<svg" in data[:2000]:
        kind = "image/svg+xml"
    if kind is None:
        raise ValueError(f"image: expected an array or a PNG, GIF, JPEG, WebP or SVG file, got {data[:8]!r}...")
    return kind


def data_uri(data: bytes) -> str:
    """The bytes of a picture as the address of an `img`."""
    return _data_uri(data, _image_kind(data))


def _data_uri(data: bytes, kind: str | None) -> str:
    return f"data:{kind or 'application/octet-stream'};base64,{base64.b64encode(data).decode()}"


def _cell(value: Any) -> str:
    if isinstance(value, bool | np.bool_):
        return f"<td>{'yes' if value else 'no'}</td>"
    if isinstance(value, int | np.integer):
        return f'<td class="number">{value:,}</td>'
    if isinstance(value, float | np.floating):
        shown = "–" if np.isnan(value) else f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"
        return f'<td class="number">{shown}</td>'
    return f"<td>{escape(str(value))}</td>"
