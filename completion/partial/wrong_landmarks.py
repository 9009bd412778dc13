"""Complete a scan with named landmarks: where they are the cause of a bad result, the judgement names them first."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from model.body import BodyModel
from model.fitting.bodies import as_body
from model.fitting.scan import Scan, all_points
from model.linear import Subject
from scanprep.depth_camera.picture import DepthPicture
from scanprep.judgement import HAND, size
from scanprep.registration.matches import Landmarks
from scanprep.registration.wrong_landmarks import find_wrong_landmarks

from .completion import ASTRAY, CONTORTED, UNEXPLAINED, Completion, Progress, complete
from .settings import CompletionConfig


def complete_named(body: BodyModel | Subject, scan: Scan, landmarks: Landmarks | None, marks: Mapping[str, int],
                   config: CompletionConfig, progress: Progress, masked: np.ndarray | None) -> Completion:
    """Complete a scan as `complete` does, and name the fault in landmarks that do not fit; `marks` are their names.

    Right landmarks end within 7 mm of their vertices on synthetic people. So the scan is completed again, with names
    exchanged or without a landmark, where one is farther than half a hand's width, or the result is not good.
    """
    done = complete(body, scan, landmarks, config, progress, masked)
    if landmarks is None:
        return done
    vertices, hand = landmarks[0], HAND * size(done.predicted)
    apart = np.linalg.norm(done.predicted.vertices[vertices] - done.scale * landmarks[1], axis=1)
    if done.judgement.verdict == "good" and apart.max() < hand / 2:
        return done
    names = {vertex: name for name, vertex in reversed(list(marks.items()))}
    called, fault = [names[vertex] for vertex in vertices.tolist()], None
    if not isinstance(scan, DepthPicture):
        points = all_points(scan)
        hidden = next((mask for mask in (masked, done.not_skin) if mask is not None), np.zeros(len(points), dtype=bool))

        def complete_again(pairs: Landmarks) -> tuple[float, np.ndarray]:
            again = complete(body, scan, (pairs[0], pairs[1] / done.scale), config, None, hidden)
            return misfit_of(body, again), again.predicted.vertices

        in_metres = vertices, done.scale * landmarks[1]
        fault = find_wrong_landmarks(as_body(body).template, done.scale * points, in_metres, called,
                                     misfit_of(body, done), complete_again)
    if fault is None and apart.max() > hand:
        fault = (f"the landmark '{called[apart.argmax()]}' is {100 * apart.max():.0f} cm from its place on the body: "
                 "correct the file, or click anew with scape pick")
    return replace(done, judgement=done.judgement.put_first(fault))


def misfit_of(body: BodyModel | Subject, done: Completion) -> float:
    """Compute what speaks against a completion, 1 for each limit: landmarks, what it leaves unexplained, and joints."""
    strange = float(as_body(body).joints_from_known(done.pose).max())
    return float(done.landmark_rms / (ASTRAY * size(done.predicted)) + (1 - done.explained) / UNEXPLAINED
                 + strange / CONTORTED)
