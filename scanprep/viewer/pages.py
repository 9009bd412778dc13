"""An app whose buttons open other apps, on one server; all tabs show the same page."""
from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from .app import App, Send
from .messages import Message


class Home(App, Protocol):
    """An app that can open other apps."""

    def enter(self, send: Send, wanted: Mapping[str, Any]) -> App:
        """Return the app of a requested page, the same app for the same page; ValueError where it cannot be opened."""
        ...

    def on_return(self, app: App) -> None:
        """React to the return from a page: show what was made there."""
        ...


class Pages:
    """A home app and the pages opened from it, one of which is shown; the others keep their state.

    The message `page` tells tabs which front end to start. Messages of tabs carry the number of their page. A click
    made before the page changed is dropped, so that it cannot act on another body. Messages of hidden pages are dropped
    too; a page greets again when it is shown.
    """

    def __init__(self, home: Home) -> None:
        self.home = home
        self._opened: list[App] = []
        self._show(0, home)
        self._lock = threading.Lock()

    def _show(self, number: int, app: App) -> None:
        """Show a page."""
        self._shown = number, app                                # a new number with every change of page
        self.name: str = app.name
        self.title: str = app.title
        self.folders: Sequence[Path] = app.folders

    @property
    def app(self) -> App:
        """Return the app that is shown."""
        return self._shown[1]

    def greet(self) -> list[Message]:
        """Return which page is shown, and its greeting."""
        shown = self._shown
        return [self._page(*shown), *shown[1].greet()]

    def handle(self, message: Message, send: Send) -> None:
        """Open or leave a page, or pass the message on to the app that is shown."""
        number, app = self._shown
        fields = dict(message.fields)
        if fields.pop("page", number) != number:
            return
        if message.kind == "enter" and app is self.home:
            self._turn_to(self.home.enter(self._sender(app, send), fields), send)
        elif message.kind == "leave" and app is not self.home:
            try:
                self.home.on_return(app)
            finally:                                             # even after an error the user gets back
                self._turn_to(self.home, send)
        else:
            app.handle(replace(message, fields=fields), self._sender(app, send))

    def receive(self, name: str, path: Path, send: Send) -> None:
        """Pass a file on to the page that is shown."""
        self.app.receive(name, path, self._sender(self.app, send))

    def close(self) -> None:
        """Close all pages."""
        for app in (*self._opened, self.home):
            app.close()

    def _turn_to(self, app: App, send: Send) -> None:
        """Show a page in all tabs."""
        if app is not self.home and app not in self._opened:
            self._opened.append(app)
        with self._lock:
            self._show(self._shown[0] + 1, app)
            send(self._page(*self._shown))
        for message in app.greet():
            self._sender(app, send)(message)

    def _page(self, number: int, app: App) -> Message:
        """Return the message that tells tabs which page is shown."""
        back = "" if app is self.home else self.home.title
        return Message("page", {"number": number, "name": app.name, "title": app.title, "back": back})

    def _sender(self, app: App, send: Send) -> Send:
        """Return a `send` for an app: to all tabs while it is shown, else nowhere."""
        def send_if_shown(message: Message) -> None:
            with self._lock:
                if app is self.app:
                    send(message)

        return send_if_shown
