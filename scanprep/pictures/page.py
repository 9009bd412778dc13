"""A report as one HTML file that needs no other file and no network."""
from __future__ import annotations

import base64
import functools
import gzip
import io
import re
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from ..console import JUDGEMENT, Metric, judgement_of, split_figures
from ..geometry.storage import write_file
from ..judgement import Judgement
from .scene import Pane, match_camera_scales, pack_scene, picture_panes
from .sheets import png_bytes, webp_bytes

# folder of the compiled viewer and its style
VIEWER = Path(__file__).parents[1] / "viewer"
# Starts the compressed viewer. A browser that cannot unpack it, or has no WebGL, goes on showing the pictures.
START = """(async () => {
const raw = atob(document.getElementById("viewer").textContent), bytes = Uint8Array.from(raw, (c) => c.charCodeAt(0));
const text = await new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
const script = document.createElement("script");
script.textContent = text;
document.head.append(script);
scapekit.start();
})().catch((error) => { document.body.classList.add("sk-pictures-only"); throw error; });"""
# at the end of every page: what a person who scans people has to know before sending it to anybody
PRIVACY = ("scapekit works without a network: no data leave your computer, unless you name a cluster. "
           "The files of this result are in the folder of this page.")
# text that is a number, with thousands separators and exponent: set flush right in tables
NUMBER = re.compile(r"[-+]?[\d,]*\.?\d+(e[-+]?\d+)?")


class Page:
    """A page built from top to bottom; every method returns the page, so that calls can be chained."""

    def __init__(self, title: str, lead: str = "") -> None:
        self.title, self.lead = title, lead
        self._parts: list[str] = []
        self._verdict = ""
        self._sections: list[str] = []
        self._scenes: list[bytes] = []

    def section(self, title: str, text: str = "") -> Page:
        """Add a heading and a paragraph below it."""
        self._sections.append(title)
        self._parts.append(f'<h2 id="s{len(self._sections)}">{escape(title)}</h2>')
        return self.text(text) if text else self

    def text(self, text: str) -> Page:
        """Add paragraphs, separated by empty lines; text between backticks is set as code."""
        self._parts += [f"<p>{_with_code(block.strip())}</p>" for block in text.split("\n\n") if block.strip()]
        return self

    def verdict(self, judgement: Judgement, following: str = "") -> Page:
        """Put a verdict on top of the page: what the result is worth in one word, why, and what to do next."""
        reasons = f": {_with_code(judgement.why)}" if judgement.reasons else ""
        below = f"<br>{_with_code(following)}" if following else ""
        self._verdict = f'<p class="verdict {judgement.verdict}"><b>{judgement.verdict}</b>{reasons}{below}</p>\n'
        return self

    def markup(self, html: str) -> Page:
        """Add raw HTML, for what the other methods cannot show."""
        self._parts.append(html)
        return self

    def picture(self, image: np.ndarray | bytes, caption: str = "", alt: str = "") -> Page:
        """Add a picture."""
        self._parts.append(_figure(image, caption, alt))
        return self

    def bodies(self, panes: Sequence[Pane], caption: str = "", height: int = 400,
               picture: np.ndarray | bytes | None = None) -> Page:
        """Add shapes that the reader can turn, one pane beside the other.

        A still picture is shown until they are drawn, and where there is no WebGL; by default what the cameras see.
        """
        panes = match_camera_scales(panes)
        if picture is None:
            low, camera = min(height, 300), panes[0].camera  # at most 300 pixels high, 1,400 wide
            columns = max(1, int(1400 / max(110, low * camera.width / camera.height + 18)))
            picture = picture_panes(panes, low, columns)
        self._parts.append(self.turning(pack_scene(panes), picture, caption, height))
        return self

    def turning(self, scene: bytes, picture: np.ndarray | bytes, caption: str = "", height: int = 400) -> str:
        """Return the HTML of a figure with a packed scene, for `markup`; the page carries the scene."""
        self._scenes.append(scene)
        still = _figure(picture if isinstance(picture, bytes) else webp_bytes(picture), caption, "")
        return still.replace("<figure>", f'<figure data-scene="scene{len(self._scenes)}" data-height="{height}">', 1)

    def figures(self, metrics: Sequence[Metric], header: Sequence[str] = ("figure", "value", "unit")) -> Page:
        """Add the table of figures that a command prints, details folded below, and the verdict on top."""
        judgement = judgement_of(metrics)
        if judgement is not None:
            self.verdict(judgement)
        main, more = split_figures(m for m in metrics if m.name != JUDGEMENT)
        self.table([(m.name, m.text(), m.unit) for m in main], header)
        if more:
            self._parts.append("<details><summary>more figures</summary>")
            self.table([(m.name, m.text(), m.unit) for m in more])
            self._parts.append("</details>")
        return self

    def table(self, rows: Iterable[Sequence[Any]], header: Sequence[str] = ()) -> Page:
        """Add a table; numbers are flush right, floats have three significant figures."""
        head = "".join(f"<th>{escape(name)}</th>" for name in header)
        body = "".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in rows)
        head = f"<thead><tr>{head}</tr></thead>" if head else ""
        self._parts.append(f'<div class="scroll"><table>{head}<tbody>{body}</tbody></table></div>')
        return self

    def chart(self, figure: Any, caption: str = "") -> Page:
        """Add a matplotlib figure as vector graphics; the same figure gives the same bytes."""
        from matplotlib import rc_context
        from matplotlib.text import Text

        out = io.BytesIO()
        for text in figure.findobj(Text):          # a name with two dollar signs is no formula
            text.set_parse_math(False)
        # a fixed salt and no date, so that ids in the file do not change from run to run
        with rc_context({"svg.hashsalt": "scapekit"}):
            figure.savefig(out, format="svg", bbox_inches="tight", metadata={"Date": None})
        return self.picture(out.getvalue(), caption)

    def html(self) -> str:
        """Return the whole page."""
        style = Path(__file__).with_name("page.css").read_text(encoding="utf-8")
        style += (VIEWER / "viewer.css").read_text(encoding="utf-8") if self._scenes else ""
        lead = f'<p class="lead">{_with_code(self.lead)}</p>' if self.lead else ""
        # a table of contents, from three sections on
        links = "".join(f'<a href="#s{i + 1}">{escape(s)}</a>' for i, s in enumerate(self._sections))
        nav = f'<nav aria-label="Contents">{links}</nav>' if len(self._sections) > 2 else ""
        # for bodies that turn: scenes, viewer and its start script; nothing on a page with pictures only
        carried = {f"scene{i + 1}": scene for i, scene in enumerate(self._scenes)}
        carried |= {"viewer": _viewer_code()} if carried else {}
        viewer = "".join(f'<script type="text/plain" id="{name}">{base64.b64encode(data).decode()}</script>\n'
                         for name, data in carried.items()) + (f"<script>{START}</script>\n" if carried else "")
        return (f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
                f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
                f"<title>{escape(self.title)}</title>\n<style>{style}</style>\n</head>\n<body>\n<main>\n"
                f"<header><h1>{escape(self.title)}</h1>{lead}{self._verdict}{nav}</header>\n"
                + "\n".join([*self._parts, f"<footer>{escape(PRIVACY)}</footer>"])
                + "\n</main>\n" + viewer + "</body>\n</html>\n")

    def write(self, path: str | Path) -> None:
        """Write the page to a file, completely or not at all."""
        write_file(path, self.html())


def link_to(name: str) -> str:
    """Return the address of a file or folder beside a page, whatever its name contains."""
    return quote(name, errors="surrogateescape")


def _with_code(text: str) -> str:
    """Convert a sentence to HTML; commands and file names between backticks are set as code."""
    return re.sub(r"`([^`\n]+)`", r"<code>\1</code>", escape(text))


@functools.cache
def _viewer_code() -> bytes:
    """Return the compressed viewer; the same bytes every time, as the archive has no date."""
    return gzip.compress((VIEWER / "viewer.js").read_bytes(), 9, mtime=0)


def _figure(image: np.ndarray | bytes, caption: str, alt: str) -> str:
    """Return the HTML of a picture with its caption."""
    data = image if isinstance(image, bytes) else png_bytes(image)
    below = f"<figcaption>{_with_code(caption)}</figcaption>" if caption else ""
    source = data_uri(data)
    size = "" if isinstance(image, bytes) else f' width="{image.shape[1]}" height="{image.shape[0]}"'
    return f'<figure><img src="{source}" alt="{escape(alt or caption or "picture")}"{size}>{below}</figure>'


def data_uri(data: bytes) -> str:
    """Return the bytes of a picture as the address of an `img`."""
    # the kind of picture follows from its first bytes
    signatures = {b"\x89PNG": "image/png", b"GIF8": "image/gif", b"\xff\xd8\xff": "image/jpeg",
                  b"RIFF": "image/webp"}
    kind = next((kind for start, kind in signatures.items() if data.startswith(start)), None)
    if kind is None and b"<svg" in data[:2000]:
        kind = "image/svg+xml"
    if kind is None:
        raise ValueError(f"image: expected an array or a PNG, GIF, JPEG, WebP or SVG file, got {data[:8]!r}...")
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def _cell(value: Any) -> str:
    """Return the HTML of one cell of a table."""
    if isinstance(value, bool | np.bool_):
        return f"<td>{'yes' if value else 'no'}</td>"
    if isinstance(value, int | np.integer):
        return f'<td class="number">{value:,}</td>'
    if isinstance(value, float | np.floating):
        shown = "–" if np.isnan(value) else f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"
        return f'<td class="number">{shown}</td>'
    number = ' class="number"' if NUMBER.fullmatch(str(value)) else ""
    breaking = re.sub(r"(?<=\w)/(?=\w)", "/<wbr>", _with_code(str(value)))      # long paths may break
    return f"<td{number}>{breaking}</td>"
