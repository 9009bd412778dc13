"""The whole body from a partial scan or from markers."""
from .animate import AnimateConfig, animate
from .fit import CompletionConfig
from .markers.files import MarkerSequence, read_markers, write_markers
from .markers.layout import MarkerLayout
from .motion import Motion
from .partial import Completion, complete

__all__ = ["AnimateConfig", "Completion", "CompletionConfig", "MarkerLayout", "MarkerSequence", "Motion", "animate",
           "complete", "read_markers", "write_markers"]
