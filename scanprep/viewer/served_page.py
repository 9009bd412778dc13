"""The page of a server as one HTML file, and the headers that protect it."""
from __future__ import annotations

import json
import re
from html import escape

# the first script removes the token from the address bar, the last one starts the front end
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
# no cache, no frames, no access for other pages
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
# policy of all answers but the page: nothing may be loaded or run
NOTHING = "default-src 'none'; frame-ancestors 'none'"


def page(title: str, name: str, script: str, style: str, server: str, nonce: str) -> str:
    """Return the HTML page that starts a front end.

    Parameters
    ----------
    title : str
        Title of the page.
    name : str
        Name of the front end, passed to `scapekit.start`.
    script, style : str
        JavaScript that defines `scapekit.start(name)`, and CSS.
    server : str
        Name of this server, by which its page recognises it.
    nonce : str
        Marks our scripts and style, see `policy`.

    Returns
    -------
    str
    """
    start = json.dumps(name).replace("<", "\\u003C")
    return PAGE.format(title=escape(title), server=escape(server), nonce=nonce, name=start,
                       style=re.sub(r"</(?=style)", r"<\\/", style, flags=re.IGNORECASE), script=_inline(script))


def policy(nonce: str) -> str:
    """Return the Content-Security-Policy of the page: own scripts only, nothing from other machines."""
    return "; ".join((
        "default-src 'none'", f"script-src 'nonce-{nonce}'",
        f"style-src-elem 'nonce-{nonce}'", "style-src-attr 'unsafe-inline'", "img-src 'self' data: blob:",
        "connect-src 'self'",
        "base-uri 'none'", "form-action 'none'", "frame-ancestors 'none'"))


def _inline(script: str) -> str:
    """Escape a script for HTML: what would end it or open a comment occurs only in its strings."""
    return re.sub(r"<(?=/script|!--|script)", r"\\x3C", script, flags=re.IGNORECASE)
