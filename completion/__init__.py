"""The whole body from a partial scan or from markers.

The public names are loaded when they are first used, so that the command line answers at once.
"""
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .animation.follow import AnimateConfig, animate
    from .animation.stream import Frame, MarkerStream
    from .markers.files import MarkerSequence, read_markers, write_markers
    from .markers.layout import MarkerLayout
    from .motion import Motion
    from .partial.colors import ColorConfig, carry_colors
    from .partial.completion import Completion, complete
    from .partial.masks import read_mask
    from .partial.settings import CompletionConfig
    from .tracking.sequence import track
    from .tracking.settings import TrackConfig

_ROOMS = {
    "animation.follow": ("AnimateConfig", "animate"),
    "animation.stream": ("Frame", "MarkerStream"),
    "markers.files": ("MarkerSequence", "read_markers", "write_markers"),
    "markers.layout": ("MarkerLayout",),
    "motion": ("Motion",),
    "partial.colors": ("ColorConfig", "carry_colors"),
    "partial.completion": ("Completion", "complete"),
    "partial.masks": ("read_mask",),
    "partial.settings": ("CompletionConfig",),
    "tracking.sequence": ("track",),
    "tracking.settings": ("TrackConfig",),
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}

__all__ = ["AnimateConfig", "ColorConfig", "Completion", "CompletionConfig", "Frame", "MarkerLayout", "MarkerSequence",
           "MarkerStream", "Motion", "TrackConfig", "animate", "carry_colors", "complete", "read_markers", "read_mask",
           "track", "write_markers"]


def __getattr__(name: str) -> Any:
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_ROOM_OF[name]}", __name__), name)
