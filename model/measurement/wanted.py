"""The most probable body with given measurements, and likely ranges of all others."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..body import BodyModel
from ..shape_statistics import Sex, list_sexes, shape_statistics
from .catalogue import CATALOGUE, find_measurements, plain
from .measure import measure
from .reading import DENSITY_SPREAD
from .tapes import Tapes


@dataclass(frozen=True, eq=False)
class WantedBody:
    """The body of `body_with_measurements`. Values are metres, and kilograms of the weight.

    Attributes
    ----------
    betas : (K,) float
    vertices : (N, 3) float, metres
        In the pose of the template.
    wanted, reached : dict of name to float
    deviations : float
        How far the body is from the mean person of its sex, standard deviations.
    rarer : float
        Share of people of its sex who are as far from the mean, or farther, in what was asked for.
    likely : dict of name to (low, value, high)
        Of every measurement that was not asked for: that of the body, and between which values nine of ten people are
        who have what was asked for.
    usual : dict of name to (low, high)
        Of every measurement that was asked for: between which values nine of ten people are who have the others.
    sex : {"female", "male"} or None
        Whose statistics were used: the sex that was named, else the more probable one.
    sex_probability : float
        That people who measure so are of this sex, if they were as many women as men; 1 where it was named.
    """

    betas: np.ndarray
    vertices: np.ndarray
    wanted: dict[str, float]
    reached: dict[str, float]
    deviations: float
    rarer: float
    likely: dict[str, tuple[float, float, float]]
    usual: dict[str, tuple[float, float]]
    sex: Sex | None = None
    sex_probability: float = 1.0

    @property
    def missed(self) -> dict[str, float]:
        """Reached minus wanted values, where they differ by more than the tolerance."""
        off = {name: self.reached[name] - value for name, value in self.wanted.items()}
        return {name: off[name] for sides in alike(self.wanted) for name in sides
                if abs(np.mean([off[one] for one in sides])) > CATALOGUE[name].exact}

    @property
    def oddest(self) -> str:
        """The wanted measurement that fits least with the others."""
        def off(name: str) -> float:
            low, high = self.usual[name]
            return abs(self.wanted[name] - 0.5 * (low + high)) / (high - low)

        return max(self.usual, key=off)


def alike(wanted: Mapping[str, float]) -> list[list[str]]:
    """Group the names of wanted measurements: left and right together where they should be the same.

    No body has both sides equal to a fraction of a millimetre, since the triangles of its sides differ.
    """
    groups = dict[tuple[str, float], list[str]]()
    for name, value in wanted.items():
        groups.setdefault((plain(name), value), []).append(name)
    return list(groups.values())


def check_wanted(given: Mapping[str, float]) -> dict[str, float]:
    """Check a user's measurements and return metres and kilograms by names of the catalogue.

    Raises
    ------
    ValueError
        An unknown name, or a value that no person has, with the unit that it seems to be in.

    Examples
    --------
    >>> check_wanted({"stature": 1.8, "weight": 78})
    {'stature': 1.8, 'weight': 78.0}
    """
    wanted = dict[str, float]()
    factors = {"centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254, "feet": 0.3048}
    heavy_factors = {"grams": 0.001}  # pounds look like kilograms
    for word, value in given.items():
        for name in find_measurements(word):
            usual = CATALOGUE[name]
            if not usual.low <= value <= usual.high:
                unit = "metres" if usual.unit == "m" else "kilograms"
                seems = [(factor * value, other) for other, factor in (
                    factors if usual.unit == "m" else heavy_factors).items()
                         if usual.low <= factor * value <= usual.high]
                hint = (f"; it is in {unit}: did you mean {word}={seems[0][0]:.4g}, which is {value:g} {seems[0][1]}?"
                        if seems else f"; the nearest is {word}={float(np.clip(value, usual.low, usual.high)):g}")
                do = "measure there" if usual.unit == "m" else "weigh"
                raise ValueError(f"{word}={value:g}: expected {usual.low:g} to {usual.high:g} {usual.unit}, which "
                                 f"people {do}{hint}")
            wanted[name] = float(value)
    if not wanted:
        raise ValueError("expected at least one measurement, such as stature=1.80")
    return wanted


def body_with_measurements(model: BodyModel, tapes: Tapes, given: Mapping[str, float], sex: Sex | None = None
                           ) -> WantedBody:
    """Find the most probable body with given measurements, and likely ranges of the others.

    The betas have a Gaussian distribution, and measurements are linear conditions on them. The derivatives are computed
    anew at each new body until the measurements are reached (Gauss-Newton). Measurements that contradict each other, or
    the model, are reached as nearly as possible.

    Parameters
    ----------
    model : BodyModel
        A model with shape components.
    tapes : Tapes
        Tapes of its template, see `find_tapes`.
    given : dict of str to float
        Metres, and kilograms of the weight; `waist` means the waist girth, `thigh` that of both thighs.
    sex : {"female", "male"}, optional
        For a model that tells women from men, as the built-in one does; by default the more probable sex.

    Returns
    -------
    WantedBody
        Betas (K,), vertices (N, 3), reached values, and ranges of all other measurements.

    Raises
    ------
    ValueError
        A model without shape components, an unknown measurement, one that the template does not have, a value that no
        person has, or a sex of a model that does not tell women from men.

    Examples
    --------
    >>> from model import find_tapes, load_built_in_model
    >>> model = load_built_in_model()
    >>> tapes = find_tapes(model.template, model.info["landmarks"])
    >>> made = body_with_measurements(model, tapes, {"stature": 1.80, "weight": 78}, "male")
    >>> round(made.reached["stature"], 3), made.likely["waist_girth"][0] < 0.87 < made.likely["waist_girth"][2]
    (1.8, True)
    """
    if not model.n_betas:
        raise ValueError("model: it has no shape components, so it has one body only")
    wanted = check_wanted(given)
    lacking = [f"{name}: {tapes.missing.get(name, 'not found on the template')}" for name in wanted
               if name not in tapes.found]
    if lacking:
        raise ValueError(f"cannot be measured on this template: {'; '.join(lacking)}")
    pose = np.zeros((len(model.skeleton.parents), 3))
    base, moves = model.vertices(pose, np.zeros(model.n_betas)), model.shape_jacobian(pose)
    of = [sex] if sex is not None or len(list_sexes(model)) < 2 else list(list_sexes(model))
    candidates = []
    for one in of:
        people = shape_statistics(model, one)
        # betas = mean + root z: z are standard normal, and people of a sex are the model for what follows
        search = _Search(base + moves @ people.mean, moves @ people.root, tapes, wanted)
        z, values, S = search.nearest_to_mean()
        candidates.append((search.log_density(z, values, S), search.body(z, S, people.mean + people.root @ z, one)))
    best = max(candidates, key=lambda pair: pair[0])
    return replace(best[1], sex_probability=1 / float(np.exp([density - best[0] for density, _ in candidates]).sum()))


class _Search:
    """The search over bodies of a Gaussian of people, z standard normal, for one with wanted measurements.

    A row is a measurement, or the mean of both sides where they should be the same, divided by its tolerance, so that
    metres and kilograms are comparable.
    """

    OFTEN = 1.6449                       # standard deviations within which 90% of a Gaussian are

    def __init__(self, base: np.ndarray, moves: np.ndarray, tapes: Tapes, wanted: Mapping[str, float]) -> None:
        self.base, self.moves, self.tapes, self.wanted = base, moves, tapes, wanted
        self.rows = alike(wanted)
        self.unit = np.array([CATALOGUE[sides[0]].exact for sides in self.rows])
        self.goal = np.array([wanted[sides[0]] for sides in self.rows]) / self.unit
        # people of one volume differ in weight; other measurements have a tenth of their tolerance
        self.unknown = np.array([DENSITY_SPREAD * wanted[sides[0]] if sides == ["weight"] else 0.1 * unit
                                 for sides, unit in zip(self.rows, self.unit, strict=True)]) / self.unit
        mean = self.readings(np.zeros(moves.shape[2]))
        if mean is None:
            raise ValueError(f"{', '.join(wanted)}: cannot be measured on the mean person of this model")
        self.mean = mean

    def readings(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Measure the body of z: rows (m,), and their derivative (m, K) by z; None where a tape does not close."""
        result = measure(self.base + self.moves @ z, self.tapes, self.tapes.axes, only=self.wanted)
        if len(result.readings) < len(self.wanted):
            return None
        slopes = {name: reading.along(self.moves) for name, reading in result.readings.items()}
        return (np.array([np.mean([result.values[name] for name in sides]) for sides in self.rows]) / self.unit,
                np.stack([np.mean([slopes[name] for name in sides], axis=0) for sides in self.rows])
                / self.unit[:, None])

    def nearest_to_mean(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find z of smallest norm whose body has the measurements, as nearly as possible; with m and S there.

        z = Sᵀ (S Sᵀ)⁻¹ (goal - m + S z), with derivatives S and measurements m computed anew at each z. Steps are
        shortened where they would be worse: a level tape that slides over a bust is far from linear.
        """
        z, (values, S) = np.zeros(self.moves.shape[2]), self.mean
        for _ in range(40):
            off = self.goal - values
            if np.abs(off).max() < 0.1:
                break
            step = _not_too_far(S, off + S @ z) - z
            step *= min(1.0, 3.0 / max(float(np.linalg.norm(step)), 1e-12))
            for share in (1.0, 0.5, 0.25, 0.125):
                tried = z + share * step
                there = self.readings(tried)
                if there is not None and np.linalg.norm(self.goal - there[0]) < np.linalg.norm(off):
                    break
            else:
                break                                                     # no shorter step helps: as near as possible
            z, (values, S) = tried, there
        return z, values, S

    def log_density(self, z: np.ndarray, values: np.ndarray, S: np.ndarray) -> float:
        """Compute the log-density of people with the wanted measurements, which are linearised around z."""
        C = S @ S.T + np.diag(self.unknown**2)
        off = self.goal - values + S @ z
        return -0.5 * float(off @ np.linalg.solve(C, off) + np.linalg.slogdet(C)[1])

    def body(self, z: np.ndarray, S: np.ndarray, betas: np.ndarray, sex: Sex | None) -> WantedBody:
        """Collect the results for the body of z."""
        from scipy.stats import chi2

        vertices = self.base + self.moves @ z
        whole = measure(vertices, self.tapes, self.tapes.axes)
        far = float(np.linalg.norm(z))
        # left and right say the same, also where they are to be different
        free = len({plain(sides[0]) for sides in self.rows})
        # covariance of z of those who have the measurements: I - Sᵀ (S Sᵀ + R)⁻¹ S
        K = np.linalg.solve(S @ S.T + np.diag(self.unknown**2), S)
        likely = dict[str, tuple[float, float, float]]()
        for name, reading in whole.readings.items():
            if name not in self.wanted:
                by_z = reading.along(self.moves)
                variance = max(float(by_z @ by_z - (S @ by_z) @ (K @ by_z)), 0.0)
                half = self.OFTEN * float(np.sqrt(variance + reading.unknown**2))
                likely[name] = (reading.value - half, reading.value, reading.value + half)
        return WantedBody(betas, vertices, dict(self.wanted), {name: whole.values[name] for name in self.wanted}, far,
                          float(chi2.sf(far**2, free)), likely, self.usual(), sex)

    def usual(self) -> dict[str, tuple[float, float]]:
        """Compute, for each wanted measurement, the range of nine of ten people who have the other ones."""
        values, S = self.mean
        C, off = S @ S.T + np.diag(self.unknown**2), self.goal - values
        what = np.array([plain(sides[0]) for sides in self.rows])
        ranges = dict[str, tuple[float, float]]()
        for i, sides in enumerate(self.rows):
            others = what != what[i]                                   # the other side says the same
            K = np.linalg.solve(C[np.ix_(others, others)], C[others, i])
            middle, half = values[i] + K @ off[others], self.OFTEN * np.sqrt(C[i, i] - K @ C[others, i])
            both = (float((middle - half) * self.unit[i]), float((middle + half) * self.unit[i]))
            ranges |= dict.fromkeys(sides, both)
        return ranges


def _not_too_far(S: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Compute Sᵀ (S Sᵀ + λ)⁻¹ wanted: the z of least norm with S z = wanted, or with norm 8 nearest to it."""
    from scipy.optimize import brentq

    squares, axes = np.linalg.eigh(S @ S.T)
    squares, along = np.maximum(squares, 0), axes.T @ wanted

    def size(logarithm: float) -> float:
        # 8 standard deviations, of all betas together, is the limit: no person is so far from the mean
        return float(np.sqrt(squares @ (along / (squares + np.exp(logarithm)))**2)) - 8.0

    least, most = np.log(0.01), np.log(squares.max() + np.abs(along).max()**2 + 1)
    damping = np.exp(brentq(size, least, most) if size(least) > 0 > size(most) else least)
    return S.T @ (axes @ (along / (squares + damping)))
