"""Design a marker set: find the markers from which bodies are estimated best."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from model.body import BodyModel

from ...motion import Progress
from ..marker_sets.layout import MarkerLayout
from .fits import DesignConfig, vertex_errors
from .greedy import ADD, REMOVE, Groups, MarkerSets, Path, exchange, improve_set, symmetric_groups
from .linear import LinearBodies, fit_bodies


@dataclass(frozen=True, eq=False)
class DesignCurve:
    """Marker sets of many sizes, each with one marker, or pair, more or less than the one before."""

    name: str                        # "removed" from all, "added" to kept ones, or "kept, removed": from the kept ones
    steps: tuple[tuple[str, ...], ...]    # labels added or removed in every step
    counts: np.ndarray               # (S,) int, markers of each set, the first included
    rmse: np.ndarray                 # (S,), metres, over all vertices and bodies, linearised


@dataclass(frozen=True, eq=False)
class MarkerDesign:
    """A marker set, and how it was found.

    Attributes
    ----------
    layout : MarkerLayout
        The set, in the order of the candidates.
    rmse : float, metres
        Over all vertices and bodies, estimated from these markers, linearised.
    full : float, metres
        RMSE by full refits.
    floor : float, metres
        RMSE of the model fitted to the whole surface of the bodies.
    other_half : float, metres
        RMSE on one half of the bodies of sets chosen on the other half; it is much larger than `rmse` for a set that
        only suits the bodies it was chosen on.
    curves : tuple of DesignCurve
    """

    layout: MarkerLayout
    rmse: float
    full: float
    floor: float
    other_half: float
    curves: tuple[DesignCurve, ...]


FEWEST = 3                           # least markers; fewer do not determine the place of a body


@dataclass(frozen=True, eq=False)
class Choice:
    """The result of the search for one set."""

    paths: dict[str, Path]
    groups: np.ndarray               # (n,) int, of the set
    rmse: float                      # metres


def design_markers(model: BodyModel, bodies: np.ndarray, candidates: MarkerLayout, config: DesignConfig | None = None,
                   progress: Progress | None = None, *, keep: Sequence[str] = (), people: np.ndarray | None = None
                   ) -> MarkerDesign:
    """Find the marker set from which the model estimates the whole surface of some bodies best.

    Every body is estimated from each set by itself, with the priors of shape and pose, and markers at their places on
    its skin. Estimates are linearised around the fit to the whole body. Sets are made by removing and adding the best
    marker, or pair, and at last by exchanges.

    Parameters
    ----------
    model : BodyModel
        With betas.
    bodies : (Z, N, 3) float, metres
        In the topology of the model's template, in any poses.
    candidates : MarkerLayout
        C markers to choose from.
    config : DesignConfig, optional
        Settings.
    progress : callable, optional
        Called with (done, total).
    keep : sequence of labels, optional
        Candidates that stay in the set, with their partners: left and right, by label, are added and removed together.
    people : (Z,) int, optional
        The person of each body; else the first half of the bodies counts as other people than the second.

    Returns
    -------
    MarkerDesign
        The layout, and errors in metres.

    Raises
    ------
    ValueError
        A model without betas, bodies of another shape, an impossible count, unknown labels.

    Examples
    --------
    >>> from completion import load_layout
    >>> from completion.mocap.marker_selection.fits import DesignConfig
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> among = load_layout("cmu41", model)
    >>> bodies = np.stack([model.vertices(model.pose_mean, betas) for betas in np.eye(2)])
    >>> quick = DesignConfig(count=6)
    >>> len(design_markers(model, bodies, among, quick).layout.labels)
    6

    [MoSh] Eq. 25, Eq. 26, Eq. 27
    """
    config = config or DesignConfig()
    groups = symmetric_groups(candidates.labels)
    kept = _groups_to_keep(candidates, groups, keep, config)
    # fit and linearise, and split the people into halves
    total = 2 * len(bodies) + 2 * len(candidates.labels)
    report_progress = progress or (lambda done, total: None)
    fits = fit_bodies(model, bodies, candidates, config, lambda done, _: report_progress(done, total))
    linear, halves = fits.linear, np.arange(len(bodies)) < (len(bodies) + 1) // 2
    if people is not None:
        names = np.unique(people)
        halves = np.isin(people, names[:(len(names) + 1) // 2])
    choice = choose(linear, groups, kept, config,
                    lambda done: report_progress(min(2 * len(bodies) + done, total), total))

    # sets chosen on one half of the bodies, measured on the other
    other: list[np.ndarray] = []
    for mine in (halves, ~halves) if halves.any() and not halves.all() else ():
        rest = linear.of(~mine)
        other.append(rest.surface_error(rest.steps(_members(groups,
                                                            choose(linear.of(mine), groups, kept, config).groups))))
    report_progress(total, total)

    # error of the set without linearisation
    chosen = _members(groups, choice.groups)
    full = float(np.sqrt(vertex_errors(model, fits.refit(chosen, config), bodies).mean()))
    # collect the result, with labels in place of numbers
    labels = candidates.labels
    curves = tuple(DesignCurve(name, tuple(tuple(labels[i] for i in groups[g]) for g in path.steps), path.counts,
                               path.rmse) for name, path in choice.paths.items())
    return MarkerDesign(candidates.without([label for i, label in enumerate(labels) if i not in chosen]), choice.rmse,
                        full, float(np.sqrt(fits.linear.rest.mean())),
                        float(np.sqrt(np.concatenate(other).mean())) if other else float("nan"), curves)


def choose(linear: LinearBodies, groups: Groups, kept: np.ndarray, config: DesignConfig,
           report_progress: Callable[[int], None] | None = None) -> Choice:
    """Search the set of `config.count` markers that contains groups `kept` (n,); return it with the curves."""
    every, free, step = np.arange(len(groups)), ~kept, [0]
    stops = {config.count, *config.through}

    def told(_: int) -> None:
        step[0] += 1
        if report_progress is not None:
            report_progress(step[0])

    # from all candidates downwards, and from the kept ones upwards
    paths = {"removed": improve_set(MarkerSets(linear, groups, every), REMOVE, free, FEWEST, stops, told),
             "added": improve_set(MarkerSets(linear, groups, np.flatnonzero(kept)), ADD, free, sum(map(len, groups)),
                                  stops,
                                  told)}
    # the better curve, and one round in which each marker of the set is compared with those left out
    best = best_path(paths, config.count)
    sets = MarkerSets(linear, groups, best.set(best.at(config.count)))
    exchange(sets, free)
    alone = MarkerSets(linear, groups, np.flatnonzero(kept))
    if alone.count > FEWEST:
        paths["kept, removed"] = improve_set(alone, REMOVE, kept, FEWEST, stops, told)
    chosen = np.flatnonzero(sets.inside)
    return Choice(paths, chosen, linear.rmse(_members(groups, chosen)))


def best_path(paths: dict[str, Path], count: int) -> Path:
    """Return the path with a set of `count` markers, or nearly as many, that has the least error there."""
    possible = [path for path in paths.values() if path.at(count) >= 0]
    return min(possible, key=lambda path: (-path.counts[path.at(count)], path.rmse[path.at(count)]))


def _groups_to_keep(candidates: MarkerLayout, groups: Groups, keep: Sequence[str], config: DesignConfig) -> np.ndarray:
    """Return a mask (n,) of groups that stay; ValueError for unknown labels or an impossible count."""
    unknown = [label for label in keep if label not in candidates.labels]
    if unknown:
        raise ValueError(f"keep: {', '.join(unknown)} not among the candidates")
    kept = np.array([any(candidates.labels[i] in keep for i in group) for group in groups])
    least, most = sum(len(g) for g, k in zip(groups, kept, strict=True) if k), len(candidates.labels)
    if not max(FEWEST, least) <= config.count <= most:
        raise ValueError(f"count: expected {max(FEWEST, least)}..{most} markers, those that stay and the candidates, "
                         f"got {config.count}")
    return kept


def _members(groups: Groups, chosen: np.ndarray) -> list[int]:
    """Return the markers of chosen groups, in rising order."""
    return sorted(i for g in chosen for i in groups[g])
