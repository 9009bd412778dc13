"""Find where tapes run on a template, once, from its landmarks and its shape."""
from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np

from scanprep.geometry.geodesics import SurfaceGraph
from scanprep.geometry.mesh import Mesh, take_any_mesh

from .marks import BodyLandmarks, body_landmarks
from .section import Carried, SectionCurve, direction, mean_of, on_the_way, part_around, section, tape
from .tapes import Extent, Found, Girth, Height, Leg, Span, Straight, Tapes, Way, Weight

# Metres that a level lies above its landmarks, on a person of 1.75 m. The built-in people's vertex named navel is at
# the lower rim of the navel, those named nipples are 2.5 cm inside and below: so say MakeHuman's targets.
NAVEL, NIPPLES = 0.009, 0.008


class _NotThereError(ValueError):
    """A measurement that cannot be found on a template; the message says why."""


@take_any_mesh
def find_tapes(template: Mesh, landmarks: Mapping[str, int]) -> Tapes:
    """Find every measurement on a template that stands upright, its arms away from the body.

    Waist and bust are as high as navel and nipples, ends of limbs are at landmarks. Hips and calves are the widest,
    neck and wrists the narrowest sections between two landmarks.

    Parameters
    ----------
    template : Mesh, metres
        A person, for example a model's template.
    landmarks : dict of str to int
        Vertices by the names of the built-in people, the SCAPE meshes or CAESAR. Toes and heels are needed, and one
        landmark of head or neck. Measurements without their landmarks are left out.

    Returns
    -------
    Tapes
        `found` and `missing` measurements by name; for `measure`.

    Raises
    ------
    ValueError
        A landmark that is needed is missing.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> tapes = find_tapes(model.template, model.info["landmarks"])
    >>> "waist_girth" in tapes.found, len(tapes.missing)
    (True, 0)
    """
    finder = _Finder(body_landmarks(template, landmarks))
    found, missing = dict[str, Found](), dict[str, str]()
    for name, find in finder.recipes():
        try:
            found[name] = find()
        except KeyError as lacking:
            missing[name] = f"the template has no landmark '{str(lacking)[1:-1]}'"
        except _NotThereError as problem:
            missing[name] = str(problem)
    return Tapes(template, finder.places.axes, found, missing, finder.limbs, finder.legs(found))


class _Finder:
    """The recipe of each measurement, on one template."""

    BAND = 0.10                          # metres along the surface, for 1.75 m: a tape stays this near to its place

    def __init__(self, places: BodyLandmarks) -> None:
        self.places, self.mesh = places, places.mesh
        self.graph = SurfaceGraph(self.mesh)
        height = self.mesh.vertices @ places.up
        self.floor, self.stature = float(height.min()), float(np.ptp(height))
        # lengths in this module are those of a person of 1.75 m
        self.scale = self.stature / 1.75
        self.limbs: dict[str, tuple[Carried, Carried]] = {}
        self.done: dict[str, Girth] = {}

    def recipes(self) -> Iterator[tuple[str, Callable[[], Found]]]:
        """Yield names and how each is found, in the order in which they build on each other."""
        p = self.places
        yield "stature", lambda: Height(None)
        yield "neck_height", lambda: Height(self.point("neck back"))
        yield "shoulder_height", lambda: Height(self.point("left shoulder", "right shoulder"))
        crown = self.floor + self.stature
        yield "head_girth", lambda: self.extreme("head_girth", 1, lambda t: self.level(
            p.at("top of head", "left ear", "right ear"), crown - (0.045 + 0.045 * t) * self.stature))
        yield "neck_girth", self.neck
        yield "chest_girth", lambda: self.trunk("chest_girth", self.above(NIPPLES, "left nipple", "right nipple"))
        yield "under_bust_girth", lambda: self.keep("under_bust_girth", self.level(
            self.middle(), p.height("left nipple", "right nipple") - 0.085 * self.scale), None, self.BAND, True)
        yield "waist_girth", self.waist
        yield "waist_height", lambda: Height(self.girth("waist_girth").height)
        yield "hip_girth", self.hips
        yield "crotch_height", lambda: Height(self.point("crotch"))
        for side in ("left", "right"):
            yield from self.leg(side)
            yield from self.arm(side)
        yield "shoulder_width", lambda: Straight(self.point("left shoulder"), self.point("right shoulder"))
        yield "chest_width", lambda: self.span("chest_girth", 1)
        yield "chest_depth", lambda: self.span("chest_girth", 2)
        yield "hip_width", lambda: self.span("hip_girth", 1)
        yield "back_length", lambda: self.way("neck back", self.at_back(self.girth("waist_girth"), "neck back"),
                                              until="waist_girth")
        yield "shoulder_length_back", lambda: self.way("left shoulder", "neck back", "right shoulder")
        yield "weight", self.weight

    def leg(self, side: str) -> Iterator[tuple[str, Callable[[], Found]]]:
        """Yield the recipes of one leg, from above."""
        p, knee, heel = self.places, (f"{side} knee", f"{side} knee inside"), f"{side} heel"
        yield f"thigh_girth_{side}", lambda: self.keep(f"thigh_girth_{side}", self.level(
            0.5 * (p.at(*knee) + p.at(f"{side} hip")), p.height("crotch") - 0.04 * self.scale), None, self.BAND)
        yield f"knee_girth_{side}", lambda: self.keep(f"knee_girth_{side}", None, self.shin(side))
        yield f"calf_girth_{side}", lambda: self.extreme(f"calf_girth_{side}", 1, lambda t: self.along(
            p.at(*knee), p.at(heel), 0.12 + 0.4 * t), self.shin(side))
        yield f"foot_length_{side}", lambda: self.foot(side)

    def arm(self, side: str) -> Iterator[tuple[str, Callable[[], Found]]]:
        """Yield the recipes of one arm, from above."""
        p, elbow = self.places, (f"{side} elbow outside", f"{side} elbow inside")
        shoulder, tip = f"{side} shoulder", f"{side} middle finger"
        yield f"upper_arm_girth_{side}", lambda: self.keep(f"upper_arm_girth_{side}", None, self.upper_arm(side))
        yield f"wrist_girth_{side}", lambda: self.extreme(f"wrist_girth_{side}", -1, lambda t: self.along(
            p.at(*elbow), p.at(tip), 0.42 + 0.26 * t), self.limb(
                f"{side} forearm", p.at(*elbow), p.at(tip), 0.12, 0.45))
        yield f"arm_length_{side}", lambda: self.way(shoulder, elbow[0], self.nearest(
            self.girth(f"wrist_girth_{side}"), elbow[0]), until=f"wrist_girth_{side}")
        yield f"hand_length_{side}", lambda: Straight(self.girth(f"wrist_girth_{side}").centre, self.point(tip))

    def weight(self) -> Weight:
        """Return the weight, for a surface that encloses a volume."""
        if not self.mesh.is_closed:
            raise _NotThereError("the template is open, so it has no volume")
        return Weight()

    def point(self, *names: str) -> Carried:
        """Return the mean of landmarks, all of which must be there."""
        for name in names:
            self.places.at(name)
        return mean_of(*(self.places.of[name] for name in names))

    def above(self, rise: float, *names: str) -> Carried:
        """Return the mean of landmarks, raised by metres of a person of 1.75 m: towards the neck, so it grows along."""
        point, neck = self.point(*names), [name for name in ("neck front", "neck back") if name in self.places.of]
        if not neck:
            return point
        top, up = self.point(*neck), self.places.up
        share = rise * self.scale / float((top.at(self.mesh.vertices) - point.at(self.mesh.vertices)) @ up)
        return on_the_way(point, top, share)

    def loop(self, origin: np.ndarray, normal: np.ndarray) -> SectionCurve:
        """Find the closed section by a plane around its point `origin` (3,), else the nearest, at most 12 cm away."""
        vertices = self.mesh.vertices
        best = part_around(section(vertices, self.mesh.faces, origin, normal), vertices, origin, normal)
        if best is None or np.linalg.norm(best.at(vertices).mean(axis=0) - origin) > 0.12 * self.scale:
            raise _NotThereError("the template has no section there")
        if not best.closed:
            raise _NotThereError("a hole of the template crosses it")
        return best

    def level(self, near: np.ndarray, height: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the level plane at a height, metres, through the point above or below `near` (3,)."""
        up = self.places.up
        return near + (height - near @ up) * up, up

    def along(self, start: np.ndarray, end: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the plane across the line between two points (3,), at a share of the way."""
        return start + share * (end - start), (end - start) / np.linalg.norm(end - start)

    def keep(self, name: str, plane: tuple[np.ndarray, np.ndarray] | None, axis: tuple[Carried, Carried] | None,
             band: float = 0.07, under_arms: bool = False, level: Carried | None = None) -> Girth:
        """Store the girth in a plane (a point, its normal), or across the beginning of an axis, by its centroid.

        The plane keeps the `level` of a point, else that of the centroid.
        """
        vertices = self.mesh.vertices
        if axis is None:
            assert plane is not None, "a girth without an axis has a plane"
            ring = self.loop(*plane)
        else:
            normal = direction(axis, vertices)
            first = self.loop(*(plane or (axis[0].at(vertices), normal)))
            ring = self.loop(first.centroid(vertices).at(vertices), normal)
        centre = ring.centroid(vertices)
        # triangles near the section along the surface, without the arms where the tape runs under them
        far, _ = self.graph.nearest(np.unique(ring.edges))
        near = (far <= band * self.scale)[self.mesh.faces].any(axis=1)
        if under_arms:
            near &= ~self.arms[self.mesh.faces].any(axis=1)
        aside = 1 if "upper_arm" in name else -1 if "thigh" in name else 0
        self.done[name] = Girth(centre, axis, self.mesh.faces[near], ring, under_arms, aside, level)
        return self.done[name]

    @cached_property
    def arms(self) -> np.ndarray:
        """(N,) bool, the vertices of arms and shoulders.

        Arms are nearer to the elbow, along the surface, than the armpit is. Shoulders are above the armpit and farther
        out; on some bodies a tape at the nipples reaches them.
        """
        marked = np.zeros(len(self.mesh.vertices), dtype=bool)
        for side, sign in (("left", 1), ("right", -1)):
            elbow, armpit = (self.places.of.get(f"{side} {name}") for name in ("elbow inside", "armpit"))
            if elbow is not None and armpit is not None:
                far = self.graph.distances(elbow)
                up, left, _ = self.places.axes @ (self.mesh.vertices - self.mesh.vertices[armpit]).T
                marked |= (far < far[armpit]) | ((up > 0) & (sign * left > 0))
        return marked

    def girth(self, name: str) -> Girth:
        """Return a girth that was found before."""
        if name not in self.done:
            raise _NotThereError(f"the template has no {name.replace('_', ' ')}")
        return self.done[name]

    def extreme(self, name: str, sign: int, plane: Callable[[float], tuple[np.ndarray, np.ndarray]],
                axis: tuple[Carried, Carried] | None = None, band: float = 0.07) -> Girth:
        """Find the girth of the longest (1) or shortest (-1) tape among 25 planes, over t from 0 to 1."""
        planes = [plane(float(t)) for t in np.linspace(0, 1, 25)]
        lengths = [sign * self.around(self.loop(*at), at[1]) for at in planes]
        return self.keep(name, planes[int(np.argmax(lengths))], axis, band)

    def around(self, ring: SectionCurve, normal: np.ndarray) -> float:
        """Compute the length, metres, of a tape around a section."""
        points = ring.at(self.mesh.vertices)
        hull = points[tape(points, normal)]
        return float(np.linalg.norm(hull - np.roll(hull, 1, axis=0), axis=1).sum())

    def trunk(self, name: str, height: Carried) -> Girth:
        """Find a level girth of the trunk, as high as a point."""
        plane = self.level(self.middle(), float(height.at(self.mesh.vertices) @ self.places.up))
        return self.keep(name, plane, None, self.BAND, name != "waist_girth", height)

    def middle(self) -> np.ndarray:
        """Return a point (3,) on the axis of the trunk."""
        p = self.places
        if {"navel", "back"} <= set(p.of):
            return p.at("navel", "back")
        return p.at("left hip", "right hip", "left shoulder", "right shoulder")

    def waist(self) -> Girth:
        """Find the waist as high as the navel, else at its landmarks, else the narrowest section of the trunk."""
        p = self.places
        if "navel" in p.of:
            return self.trunk("waist_girth", self.above(NAVEL, "navel"))
        if {"left waist", "right waist"} <= set(p.of):
            return self.trunk("waist_girth", self.point("left waist", "right waist"))
        low, high = p.height("crotch"), p.height("left nipple", "right nipple")
        return self.extreme("waist_girth", -1, lambda t: self.level(
            self.middle(), low + (0.35 + 0.5 * t) * (high - low)), None, self.BAND)

    def hips(self) -> Girth:
        """Find the widest section from the crotch up to two thirds of the way to the waist, anew on every body.

        Among people it is up to 6 cm above or below the vertices that are in the widest section of the average.
        """
        low, waist = self.point("crotch"), [name for name in ("left waist", "right waist", "navel")
                                            if name in self.places.of]
        if not waist:
            raise KeyError("navel")
        high = self.point(*waist)
        found = self.extreme("hip_girth", 1, lambda t: self.level(self.middle(), float(on_the_way(
            low, high, 0.12 + 0.55 * t).at(self.mesh.vertices) @ self.places.up)), None, self.BAND + 0.06)
        self.done["hip_girth"] = replace(found, between=(on_the_way(low, high, 0.02),
                                                               on_the_way(low, high, 0.67)))
        return self.done["hip_girth"]

    def neck(self) -> Girth:
        """Find the narrowest section across the neck, also among planes that sink towards the throat.

        The neck leans forward, and level planes meet the jaw of people who hold their chins low.
        """
        front, back = self.point("neck front"), self.point("neck back")
        foot, ears = self.point("neck front", "neck back"), self.point("left ear", "right ear")
        start = foot.at(self.mesh.vertices)

        def leaning(lean: float) -> tuple[float, Girth]:
            head = Carried(np.r_[ears.vertices, front.vertices, back.vertices],
                           np.r_[ears.weights, lean * front.weights, -lean * back.weights])
            end = head.at(self.mesh.vertices)
            girth = self.extreme("neck_girth", -1, lambda t: self.along(start, end, 0.1 + 0.6 * t), (foot, head))
            return self.around(girth.ring, end - start), girth

        tried = []
        for lean in (0.0, 0.125, 0.25, 0.375, 0.5):
            with contextlib.suppress(_NotThereError):
                tried.append(leaning(lean))
        if not tried:
            raise _NotThereError("the template has no whole neck")
        self.done["neck_girth"] = min(tried, key=lambda one: one[0])[1]
        return self.done["neck_girth"]

    def limb(self, name: str, start: np.ndarray, end: np.ndarray, first: float, second: float
             ) -> tuple[Carried, Carried]:
        """Find the axis of a limb: the centroids of two sections between its ends."""
        low, high = (self.loop(*self.along(start, end, share)).centroid(self.mesh.vertices)
                     for share in (first, second))
        self.limbs[name] = low, high
        return low, high

    def upper_arm(self, side: str) -> tuple[Carried, Carried]:
        """Find the axis of the upper arm: from its middle, or as soon as the armpit is passed, to the elbow."""
        p = self.places
        for share in (0.5, 0.56, 0.62, 0.68):
            with contextlib.suppress(_NotThereError):
                return self.limb(f"{side} upper arm", p.at(f"{side} shoulder"),
                                 p.at(f"{side} elbow outside", f"{side} elbow inside"), share, 0.95)
        raise _NotThereError("the upper arm lies against the trunk on the template")

    def shin(self, side: str) -> tuple[Carried, Carried]:
        p = self.places
        return self.limb(f"{side} shin", p.at(f"{side} knee", f"{side} knee inside"), p.at(f"{side} heel"), 0.0, 0.7)

    def span(self, girth: str, axis: int) -> Span:
        self.girth(girth)
        return Span(girth, axis)

    def behind(self, girth: Girth, name: str) -> np.ndarray:
        """Find the vertices of a girth's section beyond its plane, seen from a landmark, so that a path crosses it."""
        vertices = self.mesh.vertices
        normal = self.places.up if girth.axis is None else direction(girth.axis, vertices)
        ring, origin = np.unique(girth.ring.edges), girth.centre.at(vertices)
        side = np.sign((self.point(name).at(vertices) - origin) @ normal)
        return ring[side * ((vertices[ring] - origin) @ normal) < 0]

    def nearest(self, girth: Girth, name: str) -> int:
        """Find the vertex behind a girth that is nearest to a landmark, along the surface."""
        ring = self.behind(girth, name)
        return int(ring[self.graph.distances(self.point(name).vertices[0])[ring].argmin()])

    def at_back(self, girth: Girth, name: str) -> int:
        """Find the vertex behind a girth in the middle of the back."""
        ring = self.behind(girth, name)
        apart = self.mesh.vertices[ring] - girth.centre.at(self.mesh.vertices)
        back = apart @ self.places.axes[2] < 0
        return int(ring[back][np.abs(apart[back] @ self.places.axes[1]).argmin()])

    def way(self, *stations: str | int, until: str | None = None) -> Way:
        """Find a path along the surface, over landmarks or vertices, as far as the plane of a girth."""
        vertices = [int(self.point(s).vertices[0]) if isinstance(s, str) else s for s in stations]
        faces = []
        for start, end in itertools.pairwise(vertices):
            over = self.graph.distances(np.array([start, end])).sum(axis=0)        # path lengths over each vertex
            if not np.isfinite(over[start]):
                raise _NotThereError("no way along the surface joins its ends")
            # triangles on paths up to 5 cm longer than the shortest: other bodies may take these
            faces.append(self.mesh.faces[(over[self.mesh.faces] <= over[start] + 0.05 * self.scale).any(axis=1)])
        return Way(tuple(vertices), tuple(faces), until)

    def legs(self, found: Mapping[str, Found]) -> tuple[Leg, ...]:
        """Return both legs as heights need them; none where one of them was not found."""
        p, legs = self.places, list[Leg]()
        for side, other in (("left", "right"), ("right", "left")):
            foot, shin, twin = found.get(f"foot_length_{side}"), *(
                self.limbs.get(f"{each} shin") for each in (side, other))
            if not isinstance(foot, Extent) or shin is None or twin is None or f"{side} hip" not in p.of:
                return ()
            # On the built-in people joints of the hips are 0.58 times as far apart as the skin beside them, and the
            # bones of the lower shins 0.95 times as far as the centres of their skin.
            centres = (on_the_way(self.point(f"{side} hip"), self.point(f"{other} hip"), 0.21), shin[0],
                       on_the_way(shin[1], twin[1], 0.025))
            top, knee, end = (centre.at(self.mesh.vertices) for centre in centres)
            way = float(np.linalg.norm(top - knee) + np.linalg.norm(knee - end))
            ankle = self.floor + 0.04 * self.stature          # height of the joint, 7 cm
            height = self.mesh.vertices[foot.vertices] @ p.up
            sole = foot.vertices[height < height.min() + 0.012 * self.scale]
            arch = float((self.mesh.vertices[sole] @ p.up).mean() - height.min())
            legs.append(Leg(centres, sole, arch, float(np.linalg.norm(top - end)) / way,
                            float(top @ p.up - ankle) / float((top - end) @ p.up)))
        return tuple(legs)

    def foot(self, side: str) -> Extent:
        """Find the foot length, from heel to toes, of the low vertices on that side."""
        p = self.places
        heel, toe = self.point(f"{side} heel"), self.point(f"{side} toe")
        middle = 0.5 * (p.at(f"{side} heel") + p.at(f"{side} toe"))
        low = self.mesh.vertices @ p.up - self.floor < 0.05 * self.scale
        near = np.linalg.norm(self.mesh.vertices - middle, axis=1) < 0.2 * self.scale
        own = (self.mesh.vertices - 0.5 * (p.at("left heel") + p.at("right heel"))) @ p.axes[1]
        vertices = np.flatnonzero(low & near & ((own > 0) == (side == "left")))
        if not len(vertices):
            raise _NotThereError("the template has no foot on that side of its landmarks")
        return Extent(vertices, heel, toe)
