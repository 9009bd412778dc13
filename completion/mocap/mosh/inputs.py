"""What `mosh` takes: recordings as files or sequences, a marker set by its name or recognised, the built-in people."""
from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

from model.body import BodyModel

from ..files.markers import MarkerSequence, read_markers
from ..marker_sets.keypoints import USE, find_keypoints, measure_hips
from ..marker_sets.layout import MarkerLayout
from ..marker_sets.named import choose_layout

MarkerSource = str | Path | MarkerSequence


def read_recordings(recordings: MarkerSource | Sequence[MarkerSource]) -> list[MarkerSequence]:
    """Read the recordings that are files, and return all as sequences.

    Raises
    ------
    ValueError
        No recording, something else than a file or a sequence, and as `read_markers`.
    """
    every = [recordings] if isinstance(recordings, MarkerSource) else recordings
    if not isinstance(every, Sequence) or not every:
        raise ValueError("recordings: expected a file of markers, a MarkerSequence, or a list of at least one of "
                         f"these, got {'none' if isinstance(every, Sequence) else type(every).__name__}")
    return [each if isinstance(each, MarkerSequence) else read_markers(each) for each in every]


def load_default_model() -> BodyModel:
    """Return the model of the built-in people, for whoever names none."""
    from model.files import BUILT_IN, load_model  # imported here, as it loads the learning code

    return load_model(BUILT_IN)


def recognise_layout(model: BodyModel, layout: MarkerLayout | str | Path | None, sequences: Sequence[MarkerSequence]
                     ) -> MarkerLayout:
    """Return a layout as it is, one that is named or in a file, or the named one that fits the labels best.

    Joint centres of a video are no markers: a UserWarning.
    """
    if isinstance(layout, MarkerLayout):
        return layout
    labels = tuple(dict.fromkeys(label for each in sequences for label in each.labels))
    found, _ = choose_layout(model, layout, labels)
    if keypoints := find_keypoints(labels, found.match_labels(labels, 0), measure_hips(sequences)):
        warnings.warn(f"{', '.join(keypoints)}: {USE}", stacklevel=3)
    return found
