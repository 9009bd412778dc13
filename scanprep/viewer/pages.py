"""An app whose buttons lead to other apps and back, on one server: all of its tabs show the same page."""
from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from .app import App, Send
from .messages import Message


class Home(App, Protocol):
    """An app that has pages inside."""

    def enter(self, send: Send, wanted: Mapping[str, Any]) -> App:
        """The app of a page that is asked for, the same for the same page; ValueError where it cannot be opened."""
        ...

    def on_return(self, app: App) -> None:
        """The page was left: what it has made is now to be shown."""
        ...


class Pages:
    """A home and the pages that were opened from it, of which one is shown; those that were left stay as they are.

    The message `page` tells tabs which front end to start. What a tab sends names its page by number: a click on a page
    that was left meanwhile is dropped, so that it lands on no other body. So is what a page tells that is not shown; it
    greets when it is shown again.
    """

    def __init__(self, home: Home) -> None:
        self.home = home
        self._opened: list[App] = []
        self._show(0, home)
        self._lock = threading.Lock()

    def _show(self, number: int, app: App) -> None:
        self._shown = number, app                                # the number grows with every turn
        self.name: str = app.name
        self.title: str = app.title
        self.folders: Sequence[Path] = app.folders

    @property
    def app(self) -> App:
        """The app that is shown."""
        return self._shown[1]

    def greet(self) -> list[Message]:
        """Which page it is, and its greeting."""
        shown = self._shown
        return [self._page(*shown), *shown[1].greet()]

    def handle(self, message: Message, send: Send) -> None:
        """A page is entered or left; all else is for the app that is shown."""
        number, app = self._shown
        fields = dict(message.fields)
        if fields.pop("page", number) != number:
            return
        if message.kind == "enter" and app is self.home:
            self._turn_to(self.home.enter(self._sender(app, send), fields), send)
        elif message.kind == "leave" and app is not self.home:
            try:
                self.home.on_return(app)
            finally:                                             # whatever it has made of it, one gets back
                self._turn_to(self.home, send)
        else:
            app.handle(replace(message, fields=fields), self._sender(app, send))

    def receive(self, name: str, path: Path, send: Send) -> None:
        """A file for the page that is shown."""
        self.app.receive(name, path, self._sender(self.app, send))

    def close(self) -> None:
        """Close all."""
        for app in (*self._opened, self.home):
            app.close()

    def _turn_to(self, app: App, send: Send) -> None:
        if app is not self.home and app not in self._opened:
            self._opened.append(app)
        with self._lock:
            self._show(self._shown[0] + 1, app)
            send(self._page(*self._shown))
        for message in app.greet():
            self._sender(app, send)(message)

    def _page(self, number: int, app: App) -> Message:
        back = "" if app is self.home else self.home.title
        return Message("page", {"number": number, "name": app.name, "title": app.title, "back": back})

    def _sender(self, app: App, send: Send) -> Send:
        """Where an app sends to: to all tabs while it is shown, else nowhere."""
        def told(message: Message) -> None:
            with self._lock:
                if app is self.app:
                    send(message)

        return told
