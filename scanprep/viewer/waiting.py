"""Messages that wait for their turn; of those that replace each other only the newest does."""
from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Waiting(Generic[Item]):
    """Items in the order they came. It does not lock: whoever shares it among threads must."""

    def __init__(self) -> None:
        self._items: deque[tuple[str, Item]] = deque()

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: Item, key: str = "") -> Item | None:
        """Add an item; one with the same key takes its place and the older is returned.

        Nothing overtakes an item without a key: what was clicked between two moves of a slider sees the first of them.
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
        """The oldest key and item; IndexError where nothing waits."""
        return self._items.popleft()
