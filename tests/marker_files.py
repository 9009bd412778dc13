"""What tests of files of markers share."""
import numpy as np
import pytest

from completion.mocap.files.markers import MarkerFileError, MarkerSequence, read_markers


def sequence(rng, frames=7, labels=("C7", "LFHD", "RKNE", "RTOE"), rate=120.0):
    positions = rng.normal(size=(frames, len(labels), 3))
    positions[rng.random(positions.shape[:2]) < 0.2] = np.nan
    return MarkerSequence(positions, labels, rate)


def agree(found, expected, tolerance=1e-9):
    assert found.labels == expected.labels and found.rate == pytest.approx(expected.rate, rel=1e-9)
    np.testing.assert_array_equal(found.seen, expected.seen)
    np.testing.assert_allclose(found.positions, expected.positions, atol=tolerance)


def refused(path, *words):
    with pytest.raises(MarkerFileError) as caught:
        read_markers(path)
    message = str(caught.value)
    assert str(path) in message and "\n" not in message, message
    assert all(word in message for word in words), message
