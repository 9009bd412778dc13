"""A queue of messages in which newer ones replace older ones of the same kind."""
from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Waiting(Generic[Item]):
    """Items in order of arrival. It has no lock: threads that share it must lock."""

    def __init__(self) -> None:
        self._items: deque[tuple[str, Item]] = deque()

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: Item, key: str = "") -> Item | None:
        """Add an item; it replaces one with the same key, which is returned.

        Items never overtake one without a key: a click between two moves of a slider acts on the state after the first.
        """
        for place in range(len(self._items) - 1, -1, -1) if key else ():
            other, old = self._items[place]
            if other == key:
                self._items[place] = (key, item)
                return old
            if not other:
                break
        self._items.append((key, item))
        return None

    def take(self) -> tuple[str, Item]:
        """Remove and return the oldest key and item; IndexError where nothing waits."""
        return self._items.popleft()
