"""The first stage: the shape of a person and where the markers really sit, from some frames."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from model.body import BodyModel
from scanprep.batch.steps import Step, once
from scanprep.geometry import rotations
from scanprep.threads import one_thread

from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..results import PersonFit
from ..settings import PersonConfig
from .frame_starts import FrameStarts
from .latent_fit import LatentFit, State
from .marker_shape import spread_frames

Progress = Callable[[int, int], None]
START_SD, START_PRIOR = 0.03, 0.3    # metres and factor: the mean person carries the markers only roughly
LOOK = (1, 3)                        # before these stages loose markers are looked for
EVERY = 2                            # stages before one of which, and before the last, markers are hung anew
FEW_SEEN = 0.9                       # of the most markers that any frame has; frames with fewer are not used


@one_thread()
def find_person(model: BodyModel, sequences: MarkerSequence | Sequence[MarkerSequence], layout: MarkerLayout,
                config: PersonConfig | None = None, progress: Progress | None = None, step: Step = once
                ) -> PersonFit:
    """The betas of a person and the places of the markers on the skin, from some frames of one or more sequences.

    Betas, latent markers and the pose and place in each frame are solved for together, at first held close to the
    mean person, usual places and usual poses, then less and less. The mesh is built between the stages only, to hang
    markers that have moved on the triangles to which they are nearest now.

    Parameters
    ----------
    model : BodyModel
    sequences : MarkerSequence, or several of one subject
    layout : MarkerLayout
        Where markers usually sit on the model's template. Markers that are in no sequence are left out.
    config : PersonConfig, optional
    progress : callable, optional
        Called with (done, total).
    step : callable, optional
        Keeps the person, and what leads there, as `Room.step` does.

    Raises
    ------
    ValueError
        A model without betas, no sequence, fewer than 3 markers in common, no frame with 3 of them, a layout of
        another body, settings that make no sense.

    [MoSh] Eq. 23
    """
    config, sequences = config or PersonConfig(), one_or_more(sequences)
    _check(model, config)
    known, positions = common_markers(sequences, layout)
    return step("person", (model, known, positions, config),
                lambda: _find(model, known, positions, config, progress or (lambda done, total: None), step))


def _find(model: BodyModel, known: MarkerLayout, positions: Sequence[np.ndarray], config: PersonConfig, tell: Progress,
          step: Step) -> PersonFit:
    chosen = choose_frames(positions, config)
    targets = np.concatenate(positions)[chosen]
    total = len(chosen) + len(config.annealing)
    given = model, known, targets, config
    starts = FrameStarts(model.subject(np.zeros(min(config.n_betas, model.n_betas))), known, START_SD, START_PRIOR,
                         config.prior_shrinkage, config.start_axes)
    x = step("person, start", given, lambda: starts.find(targets, lambda done: tell(done, total)))
    fit = LatentFit(model, starts.body, known, targets, config)
    state, steps, converged = fit.start(x), 0, False
    for i, factor in enumerate(config.annealing):
        last = i == len(config.annealing) - 1
        if i in LOOK:
            state = fit.with_loose_found(state)
        elif i and (i % EVERY or last):
            state = fit.reattached(state)
        state, end = step(f"person, stage {i}", given, partial(fit.solve, state, factor, last))
        steps, converged = steps + end.iterations, bool(end.converged[0])
        tell(len(chosen) + i + 1, total)
    return _result(fit, state, _whose(positions, chosen), converged, steps)


def _result(fit: LatentFit, state: State, frames: np.ndarray, converged: bool, steps: int) -> PersonFit:
    pose, trans, _ = fit.body.split(state.x)
    moved = np.linalg.norm(fit.places(state) - fit.usual_places(state.betas), axis=1)
    return PersonFit(state.betas.copy(), fit.placed_layout(state), frames, rotations.log(rotations.exp(pose)),
                     trans.copy(), fit.residuals(state), moved, fit.energies(state), converged, steps)


def _check(model: BodyModel, config: PersonConfig) -> None:
    if not model.n_betas:
        raise ValueError("model: expected one with betas, this one knows its template's body only")
    if config.frames < 1:
        raise ValueError(f"frames: expected at least 1, got {config.frames}")
    if not config.annealing:
        raise ValueError("annealing: expected at least one factor, got none")


def one_or_more(sequences: MarkerSequence | Sequence[MarkerSequence]) -> list[MarkerSequence]:
    """The sequences as a list.

    Raises
    ------
    ValueError
        There is none.
    """
    found = [sequences] if isinstance(sequences, MarkerSequence) else list(sequences)
    if not found:
        raise ValueError("sequences: expected at least one, got none")
    return found


def common_markers(sequences: Sequence[MarkerSequence], layout: MarkerLayout
                   ) -> tuple[MarkerLayout, list[np.ndarray]]:
    """The part of a layout that is in any of the sequences, and its markers (T, L, 3) in each, metres.

    Sequences may name a marker differently, each by another alias; where one lacks a marker it is NaN.

    Raises
    ------
    ValueError
        A sequence with fewer than 3 markers of the layout.
    """
    columns = []
    for sequence in sequences:
        labels = layout.matched(sequence.labels)
        columns.append({layout.aliases.get(label, label): sequence.labels.index(label) for label in labels})
    rows = [i for i, label in enumerate(layout.labels) if any(label in mine for mine in columns)]
    kept = tuple(layout.labels[i] for i in rows)
    known = MarkerLayout(kept, layout.vertices[rows], np.asarray(layout.distances)[rows],
                         None if layout.weights is None else layout.weights[rows],
                         {alias: label for alias, label in layout.aliases.items() if label in kept},
                         tuple(label for label in layout.loose if label in kept))
    positions = []
    for sequence, mine in zip(sequences, columns, strict=True):
        there = np.full((len(sequence.positions), len(kept), 3), np.nan)
        some = [i for i, label in enumerate(kept) if label in mine]
        there[:, some] = sequence.positions[:, [mine[kept[i]] for i in some]]
        positions.append(there)
    return known, positions


def choose_frames(positions: Sequence[np.ndarray], config: PersonConfig) -> np.ndarray:
    """Frames (B,) to use, counted through all sequences (T, L, 3).

    Raises
    ------
    ValueError
        No frame with at least 3 markers, no such choice.
    """
    together = np.concatenate(positions)
    if config.choice == "spread":
        return spread_frames(together, config.frames)
    if config.choice != "random":
        raise ValueError(f"choice: expected spread or random, got {config.choice!r}")
    seen = (~np.isnan(together[..., 0])).sum(axis=1)
    if seen.max(initial=0) < 3:
        raise ValueError(f"sequences: expected a frame with at least 3 known markers, the best has "
                         f"{seen.max(initial=0)}")
    good = np.flatnonzero(seen >= max(3, FEW_SEEN * seen.max()))
    rng = np.random.default_rng(config.seed)
    return np.sort(rng.choice(good, min(config.frames, len(good)), replace=False))


def _whose(positions: Sequence[np.ndarray], chosen: np.ndarray) -> np.ndarray:
    """(B, 2) the number of the sequence and the frame in it."""
    ends = np.cumsum([len(each) for each in positions])
    which = np.searchsorted(ends, chosen, side="right")
    return np.stack([which, chosen - np.r_[0, ends][which]], axis=1)
