"""Stage one of [MoSh]: find the shape of a person and the true places of the markers, from some frames."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from model.body import BodyModel
from scanprep.batch.room import Step, run_uncached
from scanprep.console import Metric
from scanprep.geometry import rotations
from scanprep.geometry.farthest_points import farthest_points, spread_indices
from scanprep.judgement import Judgement
from scanprep.plausible import another_layout, unequal_scale
from scanprep.threads import one_thread
from scanprep.words import describe_result

from ...motion import Progress
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..marker_sets.named import fitting_layout
from .attachment import Attachment
from .frame_starts import mean_person, start_frames
from .latent_fit import ON_SKIN, LatentFit, PersonConfig

__all__ = ["PersonConfig", "PersonFit", "find_person"]


@dataclass(frozen=True, eq=False)
class PersonFit:
    """The shape of a person and the true places of the markers.

    Attributes
    ----------
    betas : (k,) float, standard deviations
    layout : MarkerLayout
        Fitted markers: three vertices of a triangle with weights, and the distance from the skin.
    frames : (B, 2) int
        Number of the sequence and of the frame, for each frame of the fit.
    poses : (B, J, 3) float, radians
    trans : (B, 3) float, metres
    residuals : (B, L) float, metres
        Distance of the markers of `layout` from their simulation; NaN where one was not seen.
    moved : (L,) float, metres
        Distance of each marker from its usual place on this person.
    energies : {str: float}
        Each term of the energy at the end.
    converged : bool
    iterations : int
    stretch : float
        How many times longer the markers would have to be along their longest axis, as `unequal_scale` asks.
    """

    betas: np.ndarray
    layout: MarkerLayout
    frames: np.ndarray
    poses: np.ndarray
    trans: np.ndarray
    residuals: np.ndarray
    moved: np.ndarray
    energies: dict[str, float]
    converged: bool
    iterations: int
    stretch: float = 1.0
    __repr__ = describe_result

    @property
    def residual(self) -> float:
        """Mean residual, metres."""
        return float(np.nanmean(self.residuals))

    def standing_off(self, usual: MarkerLayout) -> dict[str, float]:
        """Return label -> distance from the skin, metres, for markers on wands, or without the bar of the layout."""
        distances = dict(zip(usual.labels, np.asarray(usual.distances).tolist(), strict=True))
        return {label: float(found) for label, found in
                zip(self.layout.labels, np.asarray(self.layout.distances), strict=True)
                if abs(found - distances.get(label, found)) > ON_SKIN}

    def metrics(self, usual: MarkerLayout) -> list[Metric]:
        """Return a row with markers whose distance from the skin differs from the layout's."""
        off = self.standing_off(usual)
        return [Metric(f"not at the layout's distance from the skin ({', '.join(off)})",
                       1000 * float(np.mean(list(off.values()))), "mm")] if off else []

    def judgement(self, usual: MarkerLayout) -> Judgement:
        """Judge the fit by its proportions, and by how far markers were moved; loose ones may be anywhere."""
        moves = judge_moves({label: moved for label, moved in zip(self.layout.labels, self.moved, strict=True)
                             if label not in usual.loose}, len(self.moved))
        return Judgement.of(check=filter(None, [unequal_scale(self.stretch)])).merge(moves)


def judge_moves(moves: Mapping[str, float], count: int) -> Judgement:
    """Judge a person by how far some of its `count` markers were moved along the body, label -> metres.

    Examples
    --------
    >>> str(judge_moves({"LTHI": 0.02, "LKNE": 0.18}, 39))
    "check: moved by more than a hand's width: LKNE by 18 cm"
    """
    # 0.08: metres, a hand's width; a marker that is moved farther is a doubt
    far = [f"{label} by {100 * moved:.0f} cm" for label, moved in moves.items() if moved > 0.08]
    # 0.25: share of the markers beyond which the result means nothing; at most 0.1 on 4 recordings of actors, 5 of
    # clinics and 16 of other places
    if len(far) > 0.25 * count:
        return Judgement.of(f"{len(far)} of {count} markers moved by more than a hand's width: another layout, or the "
                            "labels of other places?")
    return Judgement.of(check=[f"moved by more than a hand's width: {', '.join(far)}"] if far else [])


@one_thread()
def find_person(model: BodyModel, sequences: MarkerSequence | Sequence[MarkerSequence], layout: MarkerLayout,
                config: PersonConfig | None = None, progress: Progress | None = None, step: Step = run_uncached,
                attachment: Attachment = "triangle") -> PersonFit:
    """Find the betas of a person and the places of the markers on the skin, from some frames of its sequences.

    Betas, latent markers, and the pose and place in each frame are solved for together. At first they are held close to
    the mean person, usual places and usual poses, then less and less. The mesh is built only between the stages, to
    attach moved markers to the triangles that are nearest now.

    Parameters
    ----------
    model : BodyModel
        With betas.
    sequences : MarkerSequence, or several of one subject
        Markers in metres.
    layout : MarkerLayout
        Where markers usually sit on the model's template. Markers that are in no sequence are left out.
    config : PersonConfig, optional
        Settings.
    progress : callable, optional
        Called with (done, total).
    step : callable, optional
        Keeps intermediate results, as `TaskContext.step` does.
    attachment : "triangle" or "neighbourhood"
        A latent marker in the coordinate frame of its nearest triangle, or, as in the first version of the paper, Eq. 2
        to 4, as a sum of the neighbours of its nearest vertex and the normal there.

    Returns
    -------
    PersonFit
        Betas (k,), the layout on this person, and poses (B, J, 3) in radians of the frames that were used.

    Raises
    ------
    ValueError
        A model without betas, no sequence, fewer than 3 markers in common, no frame with 3 of them, a layout of
        another body, no stage of annealing.

    Examples
    --------
    >>> from completion import load_layout
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> layout = load_layout("cmu41", model)
    >>> walk = MarkerSequence(np.stack([layout.place(model.template)] * 3), layout.labels, 120.0)
    >>> quick = PersonConfig(frames=2, n_betas=3, annealing=(10.0, 1.0))
    >>> find_person(model, walk, layout, quick).betas.shape
    (3,)

    [MoSh] Eq. 23
    """
    config, sequences = config or PersonConfig(), one_or_more(sequences)
    if not model.n_betas:
        raise ValueError("model: expected one with betas, this one knows its template's body only")
    if not config.annealing:
        raise ValueError("annealing: expected at least one factor, got none")
    # markers of the layout, and the frames to use
    known, positions = common_markers(sequences, layout)
    chosen, stages = choose_frames(positions, config), len(config.annealing)
    targets, report_progress = np.concatenate(positions)[chosen], progress or (lambda done, total: None)
    total, inputs = len(chosen) + stages, (model, known, targets, config, attachment)

    # the poses of the mean person in these frames, then everything together, stage by stage
    mean = mean_person(model.subject(np.zeros(min(config.n_betas, model.n_betas))), known)
    x = step("person, start", inputs, lambda: start_frames(mean, targets, lambda done: report_progress(done, total)))
    fit = LatentFit(model, known, targets, config, attachment)                                          # [MoSh] Eq. 15
    state, steps, converged = fit.start(x), 0, False
    for i, factor in enumerate(config.annealing):
        last = i == stages - 1
        if i % 2 or (last and i):                        # loose markers are looked for before two of the stages
            state = fit.reattach(state, i in (1, 3), last)                                 # [MoSh] Eq. 16
        rows, converged, taken = step(f"person, stage {i}", inputs,
                                      partial(fit.solve, state, factor, last))              # [MoSh] Eq. 23
        state, steps = state.with_unknowns(rows), steps + taken
        report_progress(len(chosen) + i + 1, total)

    # number frames within their sequence, and collect the result
    ends, (pose, trans) = np.cumsum([len(each) for each in positions]), fit.split(state.x)
    which = np.searchsorted(ends, chosen, side="right")
    moved = np.linalg.norm(state.places - fit.usual_places(fit.layout, state.betas), axis=1)
    return PersonFit(state.betas.copy(), fit.export_layout(state),
                     np.stack([which, chosen - np.r_[0, ends][which]], axis=1), rotations.log(rotations.exp(pose)),
                     trans.copy(), fit.residuals(state), moved, fit.energies(state), converged, steps,
                     fit.measure_stretch(state))


def doubt_layout(model: BodyModel, sequences: Sequence[MarkerSequence], layout: MarkerLayout, fit: PersonFit,
                 config: PersonConfig | None = None) -> str | None:
    """Return the doubt of a layout, with which a person was found, that a named one fits better; None without one."""
    labels = tuple(dict.fromkeys(label for each in sequences for label in each.labels))
    try:
        named, name = fitting_layout(labels, model)
    except ValueError:                                   # no named set has these labels, or is known on this body
        return None
    both = [label for label in fit.layout.labels if label in named.labels and label in layout.labels]
    apart = np.linalg.norm(layout.select(both).place(model.template) - named.select(both).place(model.template), axis=1)
    # 5 mm: the same places; and a layout that knows more labels is not asked
    if len(named.match_labels(labels, 0)) < len(fit.moved) or (len(both) and float(apart.mean()) < 0.005):
        return None
    other = find_person(model, sequences, named, config)
    gain = sum(other.energies.values()) / len(other.moved) / (sum(fit.energies.values()) / len(fit.moved))
    return another_layout(len(fit.moved), float(fit.moved.mean()), name, len(other.moved), float(other.moved.mean()),
                          gain)


def one_or_more(sequences: MarkerSequence | Sequence[MarkerSequence]) -> list[MarkerSequence]:
    """Return the sequences as a list; ValueError where there is none."""
    found = [sequences] if isinstance(sequences, MarkerSequence) else list(sequences)
    if not found:
        raise ValueError("sequences: expected at least one, got none")
    return found


def common_markers(sequences: Sequence[MarkerSequence], layout: MarkerLayout
                   ) -> tuple[MarkerLayout, list[np.ndarray]]:
    """Return the part of a layout that is in any sequence, and its markers (T, L, 3) in each, NaN if one is missing."""
    columns = [{layout.aliases.get(label, label): sequence.labels.index(label)
                for label in layout.match_labels(sequence.labels)} for sequence in sequences]
    known = layout.without([label for label in layout.labels if not any(label in column_of for column_of in columns)])
    positions = [np.full((len(sequence.positions), len(known.labels), 3), np.nan) for sequence in sequences]
    for out, sequence, column_of in zip(positions, sequences, columns, strict=True):
        rows = [i for i, label in enumerate(known.labels) if label in column_of]
        out[:, rows] = sequence.positions[:, [column_of[known.labels[i]] for i in rows]]
    return known, positions


def choose_frames(positions: Sequence[np.ndarray], config: PersonConfig) -> np.ndarray:
    """Choose well-seen frames (B,), counted through all sequences (T, L, 3): those that differ most, or random ones."""
    together = np.concatenate(positions)
    seen = (~np.isnan(together[..., 0])).sum(axis=1)
    if seen.max(initial=0) < 3:
        raise ValueError(f"sequences: expected a frame with at least 3 known markers, the best has "
                         f"{seen.max(initial=0)}")
    # 0.9: frames with fewer than that share of the most markers of any frame are not used
    good = np.flatnonzero(seen >= max(3, 0.9 * seen.max()))
    if config.published:
        rng = np.random.default_rng(0)
        return np.sort(rng.choice(good, min(config.frames, len(good)), replace=False))
    return good[spread_frames(together[good], config.frames)]


def spread_frames(positions: np.ndarray, count: int) -> np.ndarray:
    """Choose frames (B,) in which the distances between markers (T, L, 3) differ most."""
    candidates = spread_indices(len(positions), 400)
    first, second = np.triu_indices(positions.shape[1], 1)
    apart = np.linalg.norm(positions[candidates][:, first] - positions[candidates][:, second], axis=2)
    # a missing distance counts as the mean one
    there = ~np.isnan(apart)
    middle = np.where(there, apart, 0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
    apart = np.where(there, apart - middle, 0)
    return candidates[np.sort(farthest_points(apart, count, np.argmin((apart**2).sum(axis=1))))]
