"""Completion of a partial scan: a start from landmarks, the pose and shape, then the free surface; and its folder."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from model.body import BodyModel
from model.fitting.bodies import as_body
from model.fitting.free_space import free_space_violation
from model.fitting.limbs import with_limbs
from model.fitting.rounds import solve_jointly
from model.fitting.scan import Scan
from model.fitting.scan_fit import STRANGE, ScanFit, scan_fit
from model.fitting.starts import best_starts, first_starts, going_on
from model.linear import Subject
from model.people import person_judgement
from model.priors import CRUDE
from scanprep.geometry import storage
from scanprep.geometry.files import check_same_topology, read_mesh, write_mesh
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.judgement import HAND, Judgement, extent, size, unit_problem
from scanprep.registration.ground import foot_of_vertex, put_on_floor
from scanprep.skeleton.roles import in_words, joint_in_words
from scanprep.threads import one_thread

from .alternation import turns_of
from .confidence import distance_to_seen, estimate_error, posterior_error, probability_within
from .free_surface import distance_to, free_surface
from .inputs import prepare_in_metres
from .scale import ScaledBody
from .settings import CompletionConfig

Progress = Callable[[int, int], None]

KIND, VERSION = "completion", 3       # 1 had no scale, expected error and confidence, 2 no judgement
_ARRAYS = ("pose", "betas", "trans", "seen", "expected_error", "confidence")
_FACTS = ("rms", "explained", "landmark_rms", "converged", "iterations")

# Of eleven right completions of synthetic people, seen from one side or all: the worst part is expected to be off by 5
# to 14 mm, the worst joint 6 to 19 degrees from any known way to hold it, 0.988 to 0.997 of the scan has a body near.
DOUBTFUL = 0.06                      # metres that a part is expected to be off, from which on it is to be looked at
LOST_LIMB, ENTERED = 0.01, 0.01      # shares: of a picture's person without a body near, of the body in free space
# the same where hardly half of the body has data; a cylinder ends at 0.60 and 0.37, a chair at 0.57 and 0.30, one view
# of a dressed person with raised arms at 0.59 and 0.29 or 0.38
CROWDED = 0.7
# of a body, by area, outside of a scan whose edges are borders at most so often: a man in shoes whose feet were taken
# for ankles has 0.08; four right ones have 0, two of them with fists where the body has fingers
OUTSIDE, NEARLY_CLOSED = 0.02, 0.01
UNJUDGED = Judgement.of(check=["no judgement was made"])
ASTRAY, ENOUGH = 0.016, 0.9          # so far landmarks, of the size, and so little explained: left and right exchanged


@dataclass(frozen=True, eq=False)
class Completion:
    """A whole body from a partial scan.

    Attributes
    ----------
    completed : Mesh
        Follows the scan where there are data, the model elsewhere; it may leave the model's space.
    predicted : Mesh
        The model's own mesh.
    pose : (J, 3) float, radians
    betas : (K,) float, or None for the template's own body
    trans : (3,) float, metres
    seen : (N,) bool
        Vertices that had data: they were observed, the others are extrapolated.
    rms : float, metres
        Distance of the scan points that were used to the completed mesh.
    explained : float
        Share of the scan points that were used.
    landmark_rms : float, metres
        Distance of the landmarks to their vertices on the predicted mesh; NaN when there are none.
    converged : bool
    iterations : int
        Rounds of matching.
    energies : dict
        Each term of the energy at the end.
    scale : float
        Metres per unit of the scan: times this it lies on the completed mesh.
    expected_error : (N,) float, metres
        How far each vertex of the completed mesh may be from the truth, root mean square: from the true surface
        where it was seen, from its true place elsewhere. None in files of earlier versions.
    confidence : (N,) float in [0, 1]
        Probability that the vertex is within `config.tolerance` of the truth. None in files of earlier versions.
    judgement : Judgement
        Whether it can be used as it is, and why not. Of files of earlier versions: to be looked at.
    soles : (float, float), metres, or None
        Where the scan ends flat at the floor: how far the soles went beyond it before they were brought to rest there,
        and how far they still do.
    """

    completed: Mesh
    predicted: Mesh
    pose: np.ndarray
    betas: np.ndarray | None
    trans: np.ndarray
    seen: np.ndarray
    rms: float
    explained: float
    landmark_rms: float
    converged: bool
    iterations: int
    energies: dict[str, float] = field(default_factory=dict)
    scale: float = 1.0
    expected_error: np.ndarray | None = None
    confidence: np.ndarray | None = None
    judgement: Judgement = UNJUDGED
    soles: tuple[float, float] | None = None


@one_thread()
def complete(body: BodyModel | Subject, scan: Scan, landmarks: tuple[np.ndarray, np.ndarray] | None = None,
             config: CompletionConfig | None = None, progress: Progress | None = None,
             masked: np.ndarray | None = None, start: Completion | None = None) -> Completion:
    """The whole body from a scan of some of it.

    Parameters
    ----------
    body : BodyModel or Subject
        A model when the person's shape is unknown, a subject when it is known.
    scan : Mesh, PointCloud, (n, 3) or (n, 6) float, metres, or a sequence of these, or a DepthPicture
        A sequence holds several views in one frame; (n, 6) are points with normals. In any unit where
        `config.free_scale` says so. A depth picture shows one person, dressed or not; floor and walls are taken away.
    landmarks : ((L,) int, (L, 3) float), optional
        Vertices of the template and where they are on the scan; 4 to 10, at least 3. Without them the search
        starts from typical poses, rotated every way.
    progress : callable, optional
        Called with (done, total).
    masked : (n,) bool, optional
        Points, one view after the other, that are clothing or hair: the body is somewhere inside.
    start : Completion, optional
        Of the same scan and model, to go on from when landmarks were moved or added: no search, a few seconds.

    Raises
    ------
    ValueError
        Fewer than 3 landmarks, landmarks or a scan that cannot be used; a start where the scale is to be found.

    [SCAPE] Eq. 10
    """
    if start is not None and config is not None and config.free_scale:
        raise ValueError("start: expected none where the unit of the scan is not known")
    config, tell = config or CompletionConfig(), progress or (lambda done, total: None)
    total, person = config.rounds + 3, as_body(body)
    solve = solve_jointly if config.method == "joint" else turns_of(body, config)
    given = prepare_in_metres(person, scan, landmarks, masked, config)
    sized = ScaledBody(person) if config.free_scale else person
    fit = scan_fit(sized, given.cloud, given.vertices, given.points, config)
    few = fit.few()
    starts = going_on(fit, start.pose, start.trans, start.betas) if start else first_starts(fit, few)   # [SCAPE] §7
    tell(1, total)
    x, rival = with_limbs(fit, few, best_starts(few, starts))
    tell(2, total)
    solved = solve(fit, few, x, lambda done: tell(2 + done, total))       # [SCAPE] Eq. 10, Eq. 11
    x, factor = fit.body.in_metres(solved.x)
    given, open_error = given.scale_by(factor), factor * posterior_error(fit.body, solved.x, fit.precision(solved.x))
    predicted = person.template.with_vertices(person.vertices(x))
    cloud = fit.without_ignored(given.cloud, predicted)
    completed, seen, used, rms = free_surface(predicted, cloud, config)   # [SCAPE] Eq. 10, over Y
    foot = foot_of_vertex(predicted, person.skeleton)
    standing = put_on_floor(predicted, completed, foot, cloud.points, cloud.normals)
    completed = completed if standing is None else completed.with_vertices(standing.vertices)
    if cloud.person is not None:                # what it shows is clothes, and noisier than the model is inexact
        completed, rms = predicted, distance_to(predicted, cloud.points[used])
    error = estimate_error(open_error, distance_to_seen(predicted, seen), rms, person.left_out_error)
    tell(total, total)
    pose, trans, betas = person.split(x)
    shape = body.betas if isinstance(body, Subject) else betas if person.n_betas else None
    off = np.linalg.norm(predicted.vertices[given.vertices] - given.points, axis=1)
    landmark_rms = float(np.sqrt((off**2).mean())) if len(off) else np.nan
    done = Completion(completed, predicted, pose, shape, trans, seen, rms, float(used.mean()), landmark_rms,
                      solved.converged, solved.rounds, solved.energies, given.metres, error,
                      probability_within(error, config.tolerance), soles=standing.beyond if standing else None)
    problems = [problem for problem in (completion_problem(done, given.cloud.points, config.free_scale),
                                        find_contortion(fit, solved.x, float(seen.mean()), len(off) > 0)) if problem]
    found = completion_doubts(fit, solved.x, error,
                              seen) + find_unexplained(fit, done.explained) + ambiguous(fit, solved.x, rival)
    found += beyond_closed(scan, completed) if isinstance(scan, Mesh) and not config.free_scale else []
    judgement = Judgement.of(problems, found)
    if isinstance(body, BodyModel):
        judgement = judgement.merge(person_judgement(body, betas))
    return replace(done, judgement=judgement)


def find_contortion(fit: ScanFit, x: np.ndarray, seen: float, marked: bool) -> str | None:
    """Why the pose of unknowns (P,) is none that a body takes; None where it may be.

    `seen` is the share of the body with data, `marked` whether there were landmarks.
    """
    names, away = fit.body.skeleton.names, fit.body.joints_from_known(fit.body.split(x)[0])
    worst = int(away.argmax())
    # from any known way to hold a joint; a chair has 58, sides exchanged 133
    if away[worst] <= np.radians(75):
        return None
    # share of the body with data; shins and feet 0.23, one view 0.26 to 0.46
    cause = (f"a part of a body only, {100 * seen:.0f}% of it has data" if seen < 0.25 else
             "landmarks of other places, left and right exchanged" if marked else "a pose that needs landmarks")
    return (f"the {joint_in_words(names[worst])} is {np.degrees(away[worst]):.0f} degrees from any way that it is "
            f"known to be held: {cause}, or something else than a person?")


def completion_doubts(fit: ScanFit, x: np.ndarray, error: np.ndarray, seen: np.ndarray) -> list[str]:
    """Why the body of unknowns (P,) is to be looked at before it is used: what is not known of it, and what is wrong.

    `error` (N,), metres, as `estimate_error`; `seen` (N,) bool, the vertices with data. What is beyond the border of a
    picture is a guess, and no reason to doubt what is within.
    """
    names, found, shown = fit.body.skeleton.names, [], ~fit.beyond(x)
    # share of a part within the picture, below which it is beyond
    open_parts = [(float(np.sqrt((error[mine]**2).mean())), p) for p in range(len(names))
                  if (mine := fit.part == p).any() and shown[mine].mean() >= 0.5]
    for off, p in sorted(open_parts, reverse=True):
        if off > DOUBTFUL:
            share = f"{100 * seen[fit.part == p].mean():.0f}% of it was seen" if seen[fit.part == p].any() else \
                "nothing of it was seen"
            found.append(f"the {in_words(names[p])} may be {1000 * off:.0f} mm off, {share}")
    strange = fit.body.joints_from_known(fit.body.split(x)[0])
    found += [f"the {joint_in_words(names[j])} is {np.degrees(strange[j]):.0f} degrees from any way that it is known "
              "to be held" for j in np.argsort(-strange) if strange[j] > STRANGE]
    if (left_out := fit.body.left_out_error) is not None and left_out > CRUDE:
        found.append(f"the model was {1000 * left_out:.0f} mm off in poses that it was not learned from: it needs more")
    return found + find_stray(fit, x)


def find_unexplained(fit: ScanFit, explained: float) -> list[str]:
    """What of a scan no body is near, where that is a limb's worth; of a picture `find_stray` tells."""
    # share of a scan without a body near; of long hair 0.05, of clothes 0.04 to 0.31
    if fit.cloud.person is not None or 1 - explained <= 0.03:
        return []
    cause = "a second person, or clutter?" if explained < CROWDED else "clutter, or a limb elsewhere"
    return [f"{100 * (1 - explained):.1f}% of the scan has no body near: {cause}"]


def beyond_closed(scan: Mesh, body: Mesh) -> list[str]:
    """How much of a body is outside of a scan that is closed there, so that nothing can be missing; metres."""
    border = scan.edge_use == 1
    if not len(scan.faces) or border.mean() > NEARLY_CLOSED:
        return []
    there = Surface(scan).closest(body.vertices)
    ahead = np.einsum("nd,nd->n", body.vertices - there.points, scan.face_normals[there.faces]) > 0
    out = ahead & (there.distances > DOUBTFUL) & ~border[scan.face_edges[there.faces]].any(axis=1)
    share = float(body.vertex_areas[out].sum() / body.vertex_areas.sum())
    return [f"{100 * share:.1f}% of the body is outside of the scan, which is closed there: shoes, or a body that is "
            "too large"] if share > OUTSIDE else []


def ambiguous(fit: ScanFit, x: np.ndarray, rival: np.ndarray | None) -> list[str]:
    """What speaks for another body than that of unknowns (P,): a `rival` (P,), where there is one, far from it."""
    if rival is None:
        return []
    apart = np.linalg.norm(fit.mesh(x).vertices - fit.mesh(rival).vertices, axis=1)[~fit.beyond(x)].mean()
    return [f"another body, {1000 * apart:.0f} mm away in the mean, explains the scan nearly as well"] \
        if apart > DOUBTFUL else []


def find_stray(fit: ScanFit, x: np.ndarray) -> list[str]:
    """What of the body of unknowns (P,) a camera speaks against, and what of a picture's person no part is near."""
    if fit.cloud.person is None:
        return []
    entered = free_space_violation(fit.data.cameras, fit.mesh(x).vertices[fit.sample.matched]).excess > 0
    lost, found = fit.find_unexplained(x, fit.thin), []
    if lost.mean() > LOST_LIMB:
        found.append(f"{100 * lost.mean():.1f}% of what was seen of the person has no body near")
    if entered.mean() > ENTERED:
        found.append(f"{100 * entered.mean():.1f}% of the body is where the camera saw that nothing is")
    return found


def completion_problem(done: Completion, points: np.ndarray, free_scale: bool = False) -> str | None:
    """Why a completion means nothing, with the likely cause; None where it means something.

    `points` (n, 3), metres, the scan, in whatever unit it was taken to be.
    """
    off, most = done.landmark_rms / size(done.predicted), done.explained
    wrong = None if free_scale else unit_problem(extent(points), extent(done.predicted.vertices), "the scan is", 0.05)
    # share of a scan explained below which a completion means nothing: of two people 0.58; landmarks of other places
    # end at 0.18 to 0.54, a horse at 0.08
    lost = 0.5
    covered = 0.5  # share of the body with data; of one of two people it is 0.94, at 0.58 explained
    least = CROWDED if done.seen.mean() < covered else lost
    if wrong is None and done.seen.any() and most >= least and not (off > HAND or (off > ASTRAY and most < ENOUGH)):
        return None
    marks = "" if np.isnan(done.landmark_rms) else f", the landmarks are {1000 * done.landmark_rms:.0f} mm off"
    return (f"the body explains {100 * done.explained:.0f}% of the scan, {100 * done.seen.mean():.2g}% of it has "
            f"data{marks}; " + (wrong or ("landmarks of other places, left and right exchanged, or " if marks else "")
                                + "a scan of something else, another model?"))


def save_completion(folder: str | Path, completion: Completion) -> Path:
    """Write `completed.ply`, `predicted.ply` and `completion.npz` (the arrays and figures).

    Returns The folder. `completion.npz` is written last, so where it is, the meshes are too.
    """
    folder = Path(folder)
    write_mesh(folder / "completed.ply", completion.completed)
    write_mesh(folder / "predicted.ply", completion.predicted)
    arrays = {name: getattr(completion, name) for name in _ARRAYS if getattr(completion, name) is not None}
    facts = {name: getattr(completion, name) for name in (*_FACTS, "energies", "scale", "soles")}
    facts["judgement"] = str(completion.judgement)
    storage.save(folder / "completion.npz", KIND, VERSION, arrays, facts)
    return folder


def _pair(value: Any) -> tuple[float, float] | None:
    return None if value is None else (float(value[0]), float(value[1]))


def load_completion(folder: str | Path) -> Completion:
    """Read a folder of `save_completion`."""
    folder = Path(folder)
    path = folder / "completion.npz"
    header, arrays = storage.load(path, KIND, tuple(range(1, VERSION + 1)))
    with storage.taking_apart(path, "a whole completion"):
        completed, predicted = (read_mesh(folder / f"{name}.ply", unit="m") for name in ("completed", "predicted"))
        check_same_topology(folder / "predicted.ply", predicted, folder / "completed.ply", completed)
        N = len(completed.vertices)
        shapes: dict[str, tuple[int | None, ...]] = {"pose": (None, 3), "betas": (None,), "trans": (3,), "seen": (N,),
                                                     "expected_error": (N,), "confidence": (N,)}
        found: dict[str, Any] = {name: storage.numbers(arrays, name, *shape, kinds="b" if name == "seen" else "f")
                                 for name, shape in shapes.items()
                                 if name in arrays or name in ("pose", "trans", "seen")}
        facts: dict[str, Any] = {name: float(header[name]) for name in ("rms", "explained", "landmark_rms")}
        return Completion(completed, predicted, **{"betas": None, **found}, **facts,
                          converged=bool(header["converged"]), iterations=int(header["iterations"]),
                          energies={name: float(value) for name, value in header["energies"].items()},
                          scale=float(header["scale"]) if header["version"] > 1 else 1.0,
                          judgement=Judgement.read(header["judgement"]) if header["version"] > 2 else UNJUDGED,
                          soles=_pair(header.get("soles")))
