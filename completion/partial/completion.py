"""Complete a partial scan: initialise from landmarks, fit pose and shape, then let the surface follow the data."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from model.body import BodyModel
from model.fitting.bodies import as_body
from model.fitting.confidence import distance_to_seen, estimate_error, posterior_error, probability_within
from model.fitting.free_space import free_space_violation
from model.fitting.free_surface import distance_to, free_surface
from model.fitting.inside import BARE, reach_farther
from model.fitting.limbs import with_limbs, with_standing
from model.fitting.not_skin import CLOSE, NotSkin, find_not_skin
from model.fitting.rounds import solve_jointly
from model.fitting.scale import ScaledBody, check_size
from model.fitting.scan import Scan, ScanPoints, all_points
from model.fitting.scan_fit import STRANGE, ScanFit, resize_to_person, scan_fit
from model.fitting.starts import best_starts, first_starts, going_on
from model.linear import Subject
from model.people import person_judgement
from model.priors import CRUDE
from scanprep.depth_camera.picture import DepthPicture
from scanprep.geometry import storage
from scanprep.geometry.attached import take_body
from scanprep.geometry.files import check_same_topology, read_mesh, write_mesh
from scanprep.geometry.geodesics import SurfaceGraph
from scanprep.geometry.mesh import Mesh, take_any_mesh
from scanprep.geometry.surface import Surface
from scanprep.judgement import HAND, UNJUDGED, Judgement, extent, size
from scanprep.plausible import unit_problem
from scanprep.registration.ground import foot_of_vertex, put_on_floor
from scanprep.skeleton.roles import in_words, joint_in_words, part_kind
from scanprep.skeleton.tree import Skeleton
from scanprep.threads import one_thread
from scanprep.words import describe_result

from .alternation import turns_of
from .inputs import prepare_in_metres
from .settings import CompletionConfig

Progress = Callable[[int, int], None]

KIND, VERSION = "completion", 3       # 1 had no scale, expected error and confidence, 2 no judgement

# Of eleven right completions of synthetic people, seen from one side or all: the worst part is expected to be off by 5
# to 14 mm, the worst joint 6 to 19 degrees from any known way to hold it, 0.988 to 0.997 of the scan has a body near.
DOUBTFUL = 0.06                      # metres: farther off than any right body
# Metres: a part with a larger expected error is told. Of 26 naked people seen from one side six have a part that is 50
# mm off or more. All six have one beyond this, and seven others; the next below it is 25 mm.
GUESSED = 0.04
# A depth picture: largest share of the person without a body near, and of the body where the camera saw free space.
LOST_LIMB, ENTERED = 0.01, 0.01
# Least share of a scan that must lie on the body when less than half of the body has data. Wrong results, as share of
# the scan and of the body: a cylinder 0.60 and 0.37, a chair 0.57 and 0.30, one view of a dressed person with raised
# arms 0.59 and 0.29 or 0.38.
CROWDED = 0.7
# OUTSIDE is the largest share of the body's area outside a closed scan. A man in shoes whose feet were taken for
# ankles has 0.08; four correct results have 0, two of them with fists where the body has fingers. A scan counts as
# closed when at most NEARLY_CLOSED of its edges are borders.
OUTSIDE, NEARLY_CLOSED = 0.02, 0.01
# A body inside clothes is searched anew where less than this share of the scan's skin is on it. Of 41 people in seven
# kinds of clothes it is 0.62 where legs were lost, 0.89 and 0.94 on two right ones, 0.96 and more on the others.
LEFT_ALONE = 0.95
CLOSE_ERROR = 0.014                  # metres: clothes as close as skin make girths 22 to 75 mm wider
BESIDE = 0.04                        # metres from clothes, within which what seems to be skin may be clothes
MASK = "mask.json"
# Landmarks off by more than ASTRAY of the body's size, with less than ENOUGH of the scan explained, mean that left and
# right are exchanged. Either alone also occurs in correct results.
ASTRAY, ENOUGH = 0.016, 0.9
# Share of a scan without a body near: a lost limb leaves more; so do long hair, 0.05, and clothes, 0.04 to 0.31.
UNEXPLAINED = 0.03
CONTORTED = np.radians(75)           # a joint's way from its nearest known pose; a chair has 58, exchanged sides 133


@dataclass(frozen=True, eq=False)
class Completion:
    """Hold a whole body that was completed from a partial scan.

    Attributes
    ----------
    completed : Mesh
        Mesh that follows the scan where there are data, and the model elsewhere. It may leave the model's space.
    predicted : Mesh
        Mesh of the model at the fitted pose and shape.
    pose : (J, 3) float, radians
    betas : (K,) float, or None for the template's own body
    trans : (3,) float, metres
    seen : (N,) bool
        True for observed vertices; the others are extrapolated.
    rms : float, metres
        Distance of the scan points that were used to the completed mesh.
    explained : float
        Share of the scanned surface that was used: on the body, and facing as it does.
    landmark_rms : float, metres
        Distance of the landmarks to their vertices on the predicted mesh; NaN when there are none.
    converged : bool
    iterations : int
        Rounds of matching.
    energies : dict
        Each term of the energy at the end.
    scale : float, metres per unit of the scan
        Multiply the scan by it to lay it on the completed mesh.
    expected_error : (N,) float, metres
        Expected distance of each vertex from the truth, root mean square. For observed vertices it is the distance to
        the true surface, for the others to the true place. None in files of earlier versions.
    confidence : (N,) float in [0, 1]
        Probability that the vertex is within `config.tolerance` of the truth. None in files of earlier versions.
    judgement : Judgement
        Whether the result can be used as it is, and why not. Files of earlier versions get "check".
    soles : (float, float), metres, or None
        For a scan that ends flat at the floor: how far the soles were below the floor before they were lifted onto it,
        and how far they still are.
    not_skin : (n,) bool, or None
        Points of the scan that were found to be hair or clothes, one view after the other. The body is inside.
    worn : tuple of str
        The same in words: "hair on head and chest".

    Examples
    --------
    >>> from scanprep.synthetic.topology import load_topology
    >>> mesh = load_topology().mesh
    >>> seen = np.arange(len(mesh.vertices)) < 5000
    >>> result = Completion(mesh, mesh, np.zeros((16, 3)), None, np.zeros(3), seen, 0.001, 0.98, 0.004, True, 12)
    >>> float(result.seen.mean()), result.judgement.verdict
    (0.4, 'check')

    [SCAPE] §7
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
    not_skin: np.ndarray | None = None
    worn: tuple[str, ...] = ()
    __repr__ = describe_result

    @property
    def measured(self) -> float:
        """Share of the body's surface that was observed."""
        return self.completed.share_of_area(self.seen)

    def save(self, folder: str | Path) -> Path:
        """Write the completion as `scape complete` does; `load_completion` reads it.

        Where hair or clothes were found, `mask.json` lists their points, to be corrected. `completion.npz` is written
        last: where it exists, the meshes do too.

        Parameters
        ----------
        folder : str or Path
            For `completed.ply`, `predicted.ply` and `completion.npz` with pose, betas, errors and figures.

        Returns
        -------
        Path
            The folder.
        """
        folder = Path(folder)
        write_mesh(folder / "completed.ply", self.completed)
        write_mesh(folder / "predicted.ply", self.predicted)
        if self.not_skin is not None:
            storage.write_json(folder / MASK, np.flatnonzero(self.not_skin).tolist())
        array_names = ("pose", "betas", "trans", "seen", "expected_error", "confidence", "not_skin")
        arrays = {name: getattr(self, name) for name in array_names if getattr(self, name) is not None}
        fact_names = ("rms", "explained", "landmark_rms", "converged", "iterations")
        facts = {name: getattr(self, name) for name in (*fact_names, "energies", "scale", "soles", "worn")}
        facts["judgement"] = str(self.judgement)
        storage.save(folder / "completion.npz", KIND, VERSION, arrays, facts)
        return folder


@dataclass(frozen=True, eq=False)
class Fitted:
    """A completion, the points of its scan in metres, its fit and the unknowns (P,)."""

    result: Completion
    cloud: ScanPoints
    fit: ScanFit
    x: np.ndarray

    def find_not_skin(self, count: int) -> NotSkin | None:
        """Find hair and clothes on the scan, which has so many points."""
        return find_not_skin(self.result.predicted, self.fit.body, self.cloud, count)


@take_any_mesh
@one_thread()
def complete(body: BodyModel | Subject, scan: Scan, landmarks: tuple[np.ndarray, np.ndarray] | None = None,
             config: CompletionConfig | None = None, progress: Progress | None = None,
             masked: np.ndarray | None = None, start: Completion | None = None) -> Completion:
    """Complete a whole body from a partial scan.

    Parameters
    ----------
    body : BodyModel or Subject
        A model when the person's shape is unknown, a subject when it is known.
    scan : Mesh, PointCloud, (n, 3) or (n, 6) float, metres, or a sequence of these, or a DepthPicture
        A sequence holds several views in one frame; (n, 6) are points with normals. Any unit is allowed with
        `config.free_scale`. A depth picture shows one person, dressed or not; floor and walls are removed.
    landmarks : ((L,) int, (L, 3) float, metres), optional
        Vertices of the template and their places on the scan: at least 3, better 4 to 10. Without them the search
        starts from typical poses in all orientations.
    config : CompletionConfig, optional
        Settings.
    progress : callable, optional
        Called with (done, total).
    masked : (n,) bool, optional
        Points that are clothing or hair, one view after the other: the body is somewhere inside. Without it they are
        looked for, and where some are found the body is fitted again inside. All false: there are none.
    start : Completion, optional
        Earlier result for the same scan and model. The fit goes on from it without a search, which takes a few
        seconds, after landmarks were moved or added.

    Returns
    -------
    Completion
        The completed mesh (N, 3) in metres, the model's mesh, pose, shape, expected errors and a judgement.

    Raises
    ------
    ValueError
        Fewer than 3 landmarks; landmarks or a scan that cannot be used; a start where the scale is unknown.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> marks = np.linspace(0, len(model.template.vertices) - 1, 12).astype(int)
    >>> quick = CompletionConfig(rounds=2, scan_points=500, model_points=500)
    >>> found = complete(model.subject(), model.template, (marks, model.template.vertices[marks]), quick)
    >>> found.completed.vertices.shape == model.template.vertices.shape
    True

    [SCAPE] Eq. 10
    """
    if start is not None and config is not None and config.free_scale:
        raise ValueError("start: expected none where the unit of the scan is not known")
    config, report_progress = config or CompletionConfig(), progress or (lambda done, total: None)

    def tell(fitted: Fitted, points: np.ndarray, places: tuple[str, ...]) -> Completion:
        done = tell_worn(fitted.result, points, places)
        return widen_errors(done, as_body(body).skeleton, config.tolerance) if CLOSE in places else done

    # a mask that is given, or that an earlier result found, is kept
    if start is not None and masked is None and start.not_skin is not None:
        return tell(_complete(body, scan, landmarks, config, report_progress, start.not_skin, start), start.not_skin,
                    start.worn)
    first = _complete(body, scan, landmarks, config, report_progress, masked, start)
    if masked is not None or isinstance(scan, DepthPicture):
        return first.result
    # hair and clothes are found by the first body; a second one is sought inside, from which more of them stands out
    count = len(all_points(scan))
    found = first.find_not_skin(count)
    if found is None:
        return first.result
    if not found.points.any():
        return tell(first, found.points, found.places)
    if not config.free_scale:
        found = reach_farther(found, first.fit, first.x, count)
    # the fit goes on from the first pose; where skin is left without a body, as legs under a gown, it is searched anew
    def fit_inside(points: np.ndarray, start: Completion | None) -> Fitted:
        return _complete(body, scan, landmarks, config, report_progress, points, start)

    inside = fit_inside(found.points, None if config.free_scale else first.result)
    if not config.free_scale and inside.result.explained < LEFT_ALONE:
        inside = min(inside, fit_inside(found.points, None), key=lambda fitted: fitted.fit.misfit(fitted.x))
    for _ in range(0 if config.free_scale else 3):
        more = inside.find_not_skin(count)
        if more is None or (more.points & ~found.points).mean() < 0.005:    # no more than a hand stands out anew
            break
        found = found.with_more(more, inside.result.predicted, as_body(body).skeleton)
        inside = fit_inside(found.points, inside.result)
    return tell(first if inside.result.judgement.verdict == "failed" else inside, found.points, found.places)


def tell_worn(done: Completion, not_skin: np.ndarray, worn: tuple[str, ...]) -> Completion:
    """Add hair and clothes to a completion: points (n,) bool, and words. Each but hair on a head alone is a doubt."""
    inside = f"the body inside is a guess (--mask with a corrected {MASK})"
    doubts = [f"{words}: " + ("girths may be 2 to 7 cm less" if words == CLOSE else inside) for words in worn
              if words != "hair on head"]
    return replace(done, not_skin=not_skin, worn=worn, judgement=done.judgement.merge(Judgement.of(None, doubts)))


def widen_errors(done: Completion, skeleton: Skeleton, tolerance: float) -> Completion:
    """Widen the errors under clothes as close as skin: all but head, hands and feet may be farther in than the mesh."""
    kinds = np.array([part_kind(name) for name in skeleton.names])[skeleton.part_of_vertex(done.predicted)]
    known = np.zeros(len(kinds)) if done.expected_error is None else done.expected_error
    error = np.hypot(known, np.where(np.isin(kinds, BARE), 0, CLOSE_ERROR))
    return replace(done, expected_error=error, confidence=probability_within(error, tolerance))


def _complete(body: BodyModel | Subject, scan: Scan, landmarks: tuple[np.ndarray, np.ndarray] | None,
              config: CompletionConfig, report_progress: Progress, masked: np.ndarray | None, start: Completion | None
              ) -> Fitted:
    """Complete a scan whose mask is known."""
    # check the input and bring scan and landmarks into metres
    total, person = config.rounds + 3, as_body(body)
    solve = solve_jointly if config.method == "joint" else turns_of(body, config)
    inputs = prepare_in_metres(person, scan, landmarks, masked, config)
    # lengths of the search are those of a person; pictures and the alternation keep their own
    sized, enlarged = (person, 1.0) if inputs.cloud.person or config.method != "joint" else resize_to_person(person)
    inputs = inputs.scale_by(enlarged)
    free = ScaledBody(sized) if config.free_scale else sized
    fit = scan_fit(free, inputs.cloud, inputs.vertices, inputs.points, config)
    # initialise: many starts with few points, the best ones with each limb tried in other poses [SCAPE] §7
    sparse = fit.few()
    starts = going_on(fit, enlarged, start.pose, start.trans, start.betas) if start else first_starts(fit, sparse)
    report_progress(1, total)
    starts = best_starts(sparse, starts)
    if fit.body is person:
        check_size(person, sparse, starts[0])
    x, rival = with_standing(fit, sparse, *with_limbs(fit, sparse, starts))
    report_progress(2, total)
    # fit pose, shape and place to the scan
    solved = solve(fit, sparse, x, lambda done: report_progress(2 + done, total))       # [SCAPE] Eq. 10, Eq. 11
    x, factor = fit.body.in_metres(solved.x)
    open_error = factor * posterior_error(fit.body, solved.x, fit.precision(solved.x))
    inputs = inputs.scale_by(factor)
    # let the surface follow the scan where it has data, and lift the soles onto the floor
    predicted = person.template.with_vertices(person.vertices(x))
    cloud = fit.without_ignored(inputs.cloud, predicted)
    completed, seen, used, rms = free_surface(predicted.with_vertices(enlarged * predicted.vertices),
                                              cloud.scale_by(enlarged), config.surface_weight)  # [SCAPE] Eq. 10, over Y
    completed, rms = completed.with_vertices(completed.vertices / enlarged), rms / enlarged
    foot = foot_of_vertex(predicted, person.skeleton)
    standing = put_on_floor(predicted, completed, foot, cloud.points, cloud.normals)
    completed = completed if standing is None else completed.with_vertices(standing.vertices)
    # a depth picture shows clothes, and its noise is larger than the model's error
    if cloud.person is not None:
        completed, rms = predicted, distance_to(predicted, cloud.some(used))
    # the expected error of every vertex, by lengths of a person, and the residuals of the landmarks
    bare = seen if cloud.masked is None else seen & ~near_clothes(predicted, cloud.masked.points)
    left_out = None if person.left_out_error is None else enlarged * person.left_out_error
    error = estimate_error(enlarged * open_error, enlarged * distance_to_seen(predicted, bare), enlarged * rms,
                           left_out) / enlarged
    report_progress(total, total)
    pose, trans, betas = person.split(x)
    shape = body.betas if isinstance(body, Subject) else betas if person.n_betas else None
    distances = np.linalg.norm(predicted.vertices[inputs.vertices] - inputs.points, axis=1)
    landmark_rms = float(np.sqrt((distances**2).mean())) if len(distances) else np.nan
    result = Completion(completed, predicted, pose, shape, trans, seen, rms, cloud.share_of_area(used), landmark_rms,
                        solved.converged, solved.rounds, solved.energies,
                        inputs.metres if config.free_scale else 1.0, error,
                        probability_within(error, config.tolerance), soles=standing.beyond if standing else None)
    # judge the result: reasons why it means nothing, then reasons to look at it
    problems = [completion_problem(result, inputs.cloud.points, config.free_scale),
                find_contortion(fit, solved.x, result.measured, len(distances) > 0)]
    doubts = (completion_doubts(fit, solved.x, error, seen) + find_unexplained(fit, result.explained)
              + ambiguous(fit, solved.x, rival))
    doubts += beyond_closed(scan, completed) if isinstance(scan, Mesh) and not config.free_scale else []
    judgement = Judgement.of(list(filter(None, problems)), doubts)
    if isinstance(body, BodyModel):
        judgement = judgement.merge(person_judgement(body, betas))
    return Fitted(replace(result, judgement=judgement), inputs.cloud, fit, solved.x)


def near_clothes(body: Mesh, clothes: np.ndarray) -> np.ndarray:
    """Find the vertices (N,) bool of a body under or beside points (m, 3) of clothes, whose edges follow no line."""
    under = np.unique(body.faces[Surface(body).closest(clothes).faces])
    return SurfaceGraph(body).nearest(under)[0] < BESIDE


def find_contortion(fit: ScanFit, x: np.ndarray, seen: float, marked: bool) -> str | None:
    """Return why no body can take the pose of the unknowns x (P,), or None where it is possible.

    `seen` is the share of the body with data; `marked` says whether there were landmarks.
    """
    names, away = fit.body.skeleton.names, fit.body.joints_from_known(fit.body.split(x)[0])
    worst = int(away.argmax())
    if away[worst] <= CONTORTED:
        return None
    # name the likely cause; 0.25 of the body with data: shins and feet alone have 0.23, one view 0.26 to 0.46
    cause = (f"a part of a body only, {100 * seen:.0f}% of it has data" if seen < 0.25 else
             "landmarks of other places, left and right exchanged" if marked else "a pose that needs landmarks")
    return (f"the {joint_in_words(names[worst])} is {np.degrees(away[worst]):.0f} degrees from any way that it is "
            f"known to be held: {cause}, or something else than a person?")


def completion_doubts(fit: ScanFit, x: np.ndarray, error: np.ndarray, seen: np.ndarray) -> list[str]:
    """Return reasons to look at the body of unknowns x (P,) before it is used.

    `error` (N,), metres, is that of `estimate_error`; `seen` (N,) bool marks the vertices with data. Parts outside the
    border of a picture are a guess and give no reason.
    """
    names, doubts, shown = fit.body.skeleton.names, [], ~fit.beyond(x)
    areas, metres = fit.body.template.vertex_areas, fit.body.in_metres(x)[1]
    # parts with a large expected error, the worst first; less than half within the picture counts as outside
    open_parts = [(float(np.sqrt((error[of_part]**2).mean())), p) for p in range(len(names))
                  if (of_part := fit.part == p).any() and shown[of_part].mean() >= 0.5]
    for off, p in sorted(open_parts, reverse=True):
        if off > GUESSED * metres:
            share = areas[seen & (fit.part == p)].sum() / areas[fit.part == p].sum()
            much = f"{100 * share:.0f}% of it was seen" if share else "nothing of it was seen"
            doubts.append(f"the {in_words(names[p])} may be {1000 * off:.0f} mm off, {much}")
    # joints far from every known pose
    strange = fit.body.joints_from_known(fit.body.split(x)[0])
    doubts += [f"the {joint_in_words(names[j])} is {np.degrees(strange[j]):.0f} degrees from any way that it is known "
               "to be held" for j in np.argsort(-strange) if strange[j] > STRANGE]
    # a model that is inexact on poses it was not learned from
    if (left_out := fit.body.left_out_error) is not None and left_out > CRUDE * metres * size(fit.body.template):
        doubts.append(f"the model was {1000 * left_out:.0f} mm off in poses that it was not learned from: "
                      "it needs more")
    return doubts + find_stray(fit, x)


def find_unexplained(fit: ScanFit, explained: float) -> list[str]:
    """Return how much of the scan has no body near, if it is as much as a limb; pictures have `find_stray`."""
    if fit.cloud.person is not None or 1 - explained <= UNEXPLAINED:
        return []
    cause = "a second person, or clutter?" if explained < CROWDED else \
        "more hair or clothes, or clutter" if fit.cloud.masked is not None else "clutter, or a limb elsewhere"
    return [f"{100 * (1 - explained):.1f}% of the scan has no body near: {cause}"]


def beyond_closed(scan: Mesh, body: Mesh) -> list[str]:
    """Return how much of the body lies outside a closed scan, in which no surface can be missing."""
    border = scan.edge_use == 1
    if not len(scan.faces) or border.mean() > NEARLY_CLOSED:
        return []
    # vertices clearly in front of the surface, and not above a hole
    nearest = Surface(scan).closest(body.vertices)
    in_front = np.einsum("nd,nd->n", body.vertices - nearest.points, scan.face_normals[nearest.faces]) > 0
    outside = in_front & (nearest.distances > DOUBTFUL) & ~border[scan.face_edges[nearest.faces]].any(axis=1)
    share = float(body.vertex_areas[outside].sum() / body.vertex_areas.sum())
    return [f"{100 * share:.1f}% of the body is outside of the scan, which is closed there: shoes, or a body that is "
            "too large"] if share > OUTSIDE else []


def ambiguous(fit: ScanFit, x: np.ndarray, rival: np.ndarray | None) -> list[str]:
    """Return a doubt where a `rival` (P,) explains the scan as well as x (P,) and lies far from it."""
    if rival is None:
        return []
    # mean distance of the two bodies, without what lies outside the picture
    apart = np.linalg.norm(fit.mesh(x).vertices - fit.mesh(rival).vertices, axis=1)[~fit.beyond(x)].mean()
    off = 1000 * fit.body.in_metres(x)[1] * apart
    words = f"another body, {off:.0f} mm away in the mean, explains the scan nearly as well"
    return [words] if apart > DOUBTFUL else []


def find_stray(fit: ScanFit, x: np.ndarray) -> list[str]:
    """Return how much of the body x (P,) enters free space, and how much of a picture's person no body explains."""
    if fit.cloud.person is None:
        return []
    # shares of the body in free space, and of the person's points without a body near
    entered = free_space_violation(fit.data.cameras, fit.mesh(x).vertices[fit.sample.matched]).excess > 0
    lost, doubts = fit.find_unexplained(x, fit.thin), []
    if (share := fit.thin.share_of_area(lost)) > LOST_LIMB:
        doubts.append(f"{100 * share:.1f}% of what was seen of the person has no body near")
    if entered.mean() > ENTERED:
        doubts.append(f"{100 * entered.mean():.1f}% of the body is where the camera saw that nothing is")
    return doubts


def completion_problem(done: Completion, points: np.ndarray, free_scale: bool = False) -> str | None:
    """Return why a completion means nothing, with the likely cause, or None where it is meaningful.

    `points` (n, 3), metres, are the scan in the unit that was assumed.
    """
    relative_error, explained = done.landmark_rms / size(done.predicted), done.explained
    wrong = None if free_scale else unit_problem(extent(points), extent(done.predicted.vertices), "the scan is", 0.05)
    # least share of the scan that must lie on the body: wrong landmarks end at 0.18 to 0.54, a horse at 0.08, one of
    # two people at 0.58, which is a right result for that person
    lost = 0.5
    covered = 0.5  # share of the body with data, below which CROWDED is asked; one of two people has 0.94
    least = CROWDED if done.measured < covered else lost
    far_off = relative_error > HAND or (relative_error > ASTRAY and explained < ENOUGH)
    if wrong is None and done.seen.any() and explained >= least and not far_off:
        return None
    # name the likely cause: the unit, the landmarks, or another subject
    marks = "" if np.isnan(done.landmark_rms) else f", the landmarks are {1000 * done.landmark_rms:.0f} mm off"
    beside = "a second person or clutter, which scape prep clean takes off, or " if done.measured > CROWDED else ""
    return (f"the body explains {100 * done.explained:.0f}% of the scan, {100 * done.measured:.2g}% of it has "
            f"data{marks}; " + (wrong or ("landmarks of other places, left and right exchanged, or " if marks else "")
                                + f"{beside}a scan of something else, its up axis to be named (--up), or another "
                                "model?"))


def load_completion(folder: str | Path) -> Completion:
    """Read the result of `scape complete` from its folder.

    Parameters
    ----------
    folder : str or Path
        With `completed.ply`, `predicted.ply` and `completion.npz`.

    Returns
    -------
    Completion
        Files of earlier versions lack what these did not store, see `Completion`.

    Raises
    ------
    StorageError
        A file that is missing or damaged, meshes of different triangles, arrays of other shapes.

    Examples
    --------
    >>> from scanprep.synthetic.topology import load_topology
    >>> mesh = load_topology().mesh
    >>> seen = np.ones(len(mesh.vertices), dtype=bool)
    >>> result = Completion(mesh, mesh, np.zeros((16, 3)), None, np.zeros(3), seen, 0.001, 0.98, 0.004, True, 12)
    >>> load_completion(result.save("completed")).iterations
    12

    [SCAPE] §7
    """
    folder = Path(folder)
    path = folder / "completion.npz"
    header, arrays = storage.load(path, KIND, tuple(range(1, VERSION + 1)))
    with storage.taking_apart(path, "a whole completion"):
        # without the eyes that the model has attached to its body
        completed, predicted = (take_body(read_mesh(folder / f"{name}.ply", unit="m"))
                                for name in ("completed", "predicted"))
        check_same_topology(folder / "predicted.ply", predicted, folder / "completed.ply", completed)
        # arrays with their expected shapes; betas and errors may be missing, the others may not
        N = len(completed.vertices)
        shapes: dict[str, tuple[int | None, ...]] = {"pose": (None, 3), "betas": (None,), "trans": (3,), "seen": (N,),
                                                     "expected_error": (N,), "confidence": (N,), "not_skin": (None,)}
        flags = "seen", "not_skin"
        stored: dict[str, Any] = {name: storage.numbers(arrays, name, *shape, kinds="b" if name in flags else "f")
                                  for name, shape in shapes.items()
                                  if name in arrays or name in ("pose", "trans", "seen")}
        facts: dict[str, Any] = {name: float(header[name]) for name in ("rms", "explained", "landmark_rms")}
        soles = header.get("soles")
        return Completion(completed, predicted, **{"betas": None, **stored}, **facts,
                          converged=bool(header["converged"]), iterations=int(header["iterations"]),
                          energies={name: float(value) for name, value in header["energies"].items()},
                          scale=float(header["scale"]) if header["version"] > 1 else 1.0,
                          judgement=Judgement.read(header["judgement"]) if header["version"] > 2 else UNJUDGED,
                          soles=None if soles is None else (float(soles[0]), float(soles[1])),
                          worn=tuple(map(str, header.get("worn", ()))))
