"""The page of a server: one HTML file with everything in it, and the headers that keep it to itself."""
from __future__ import annotations

import json
import re
from html import escape

PAGE = """<!doctype html>
<html lang="en" data-server="{server}">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<link rel="icon" href="data:,">
<style nonce="{nonce}">{style}</style>
</head>
<body>
<script nonce="{nonce}">history.replaceState(null, "", location.pathname + location.hash)</script>
<script nonce="{nonce}">{script}</script>
<script nonce="{nonce}">scapekit.start({name})</script>
</body>
</html>
"""
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
NOTHING = "default-src 'none'; frame-ancestors 'none'"


def page(title: str, name: str, script: str, style: str, server: str, nonce: str) -> str:
    """The page that starts the front end `name` of the bundle `script`; the address bar loses the token.

    Parameters
    ----------
    script : str
        JavaScript that defines `scapekit.start(name)`.
    server : str
        Name of this server, by which its page knows it again.
    nonce : str
        Marks the scripts and the style as ours, see `policy`.
    """
    start = json.dumps(name).replace("<", "\\u003C")
    return PAGE.format(title=escape(title), server=escape(server), nonce=nonce, name=start,
                       style=re.sub(r"</(?=style)", r"<\\/", style, flags=re.IGNORECASE), script=_inline(script))


def policy(host: str, nonce: str) -> str:
    """The Content-Security-Policy of the page: its own scripts, workers it makes itself, nothing of other machines."""
    return "; ".join((
        "default-src 'none'", f"script-src 'nonce-{nonce}' 'wasm-unsafe-eval'", "worker-src blob:",
        f"style-src-elem 'nonce-{nonce}'", "style-src-attr 'unsafe-inline'", "img-src 'self' data: blob:",
        f"connect-src 'self' ws://{host} data: blob:", "media-src blob:", "font-src data:",
        "base-uri 'none'", "form-action 'none'", "frame-ancestors 'none'"))


def _inline(script: str) -> str:
    """A script as it may stand in HTML: what would end it or open a comment occurs in its texts only."""
    return re.sub(r"<(?=/script|!--|script)", r"\\x3C", script, flags=re.IGNORECASE)
