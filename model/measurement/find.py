"""Tapes found once on a template, from its landmarks and its shape."""
from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property

import numpy as np

from scanprep.geometry.geodesics import SurfaceGraph
from scanprep.geometry.mesh import Mesh

from .marks import BodyLandmarks, body_landmarks
from .section import Carried, SectionCurve, direction, mean_of, section, tape
from .tapes import Extent, Found, Girth, Height, Span, Straight, Tapes, Way, Weight

BAND = 0.10                          # how far from its place on the template a tape may run, along the surface


class _NotThere(ValueError):
    """A measurement that a template does not have, and why."""


def find_tapes(template: Mesh, landmarks: Mapping[str, int]) -> Tapes:
    """Find every measurement on a template that stands upright, its arms away from the body.

    Waist, bust and ends of limbs are at landmarks; hips and calves are the widest, neck and wrists the narrowest
    sections between two of them.

    Parameters
    ----------
    template : Mesh
    landmarks : name to vertex
        Under the names of the built-in people, the SCAPE meshes or CAESAR. Toes and heels are needed, and one of
        head or neck; what begins at another landmark is left out where there is none.

    Raises
    ------
    ValueError
        A landmark that is needed is missing.
    """
    finder = _Finder(body_landmarks(template, landmarks))
    found, missing = dict[str, Found](), dict[str, str]()
    for name, find in finder.recipes():
        try:
            found[name] = find()
        except KeyError as lacking:
            missing[name] = f"the template has no landmark '{str(lacking)[1:-1]}'"
        except _NotThere as problem:
            missing[name] = str(problem)
    return Tapes(template, finder.places.axes, found, missing, finder.limbs)


class _Finder:
    """The recipe of each measurement, on one template."""

    def __init__(self, places: BodyLandmarks) -> None:
        self.places, self.mesh = places, places.mesh
        self.graph = SurfaceGraph(self.mesh)
        height = self.mesh.vertices @ places.up
        self.floor, self.stature = float(height.min()), float(np.ptp(height))
        # lengths above are those of somebody of 1.75 m
        self.scale = self.stature / 1.75
        self.limbs: dict[str, tuple[Carried, Carried]] = {}
        self.done: dict[str, Girth] = {}

    def recipes(self) -> Iterator[tuple[str, Callable[[], Found]]]:
        """Names and how each is found, in the order in which they build on each other."""
        p = self.places
        yield "stature", lambda: Height(None)
        yield "neck_height", lambda: Height(self.point("neck back"))
        yield "shoulder_height", lambda: Height(self.point("left shoulder", "right shoulder"))
        crown = self.floor + self.stature
        yield "head_girth", lambda: self.extreme("head_girth", 1, lambda t: self.level(
            p.at("top of head", "left ear", "right ear"), crown - (0.045 + 0.045 * t) * self.stature))
        yield "neck_girth", self.neck
        yield "chest_girth", lambda: self.trunk("chest_girth", p.height("left nipple", "right nipple"))
        yield "under_bust_girth", lambda: self.trunk(
            "under_bust_girth", p.height("left nipple", "right nipple") - 0.085 * self.scale)
        yield "waist_girth", self.waist
        yield "waist_height", lambda: Height(self.girth("waist_girth").centre)
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
        """Of one leg, from above."""
        p, knee, heel = self.places, (f"{side} knee", f"{side} knee inside"), f"{side} heel"
        yield f"thigh_girth_{side}", lambda: self.keep(f"thigh_girth_{side}", self.level(
            0.5 * (p.at(*knee) + p.at(f"{side} hip")), p.height("crotch") - 0.04 * self.scale), None, BAND)
        yield f"knee_girth_{side}", lambda: self.keep(f"knee_girth_{side}", None, self.shin(side))
        yield f"calf_girth_{side}", lambda: self.extreme(f"calf_girth_{side}", 1, lambda t: self.along(
            p.at(*knee), p.at(heel), 0.12 + 0.4 * t), self.shin(side))
        yield f"foot_length_{side}", lambda: self.foot(side)

    def arm(self, side: str) -> Iterator[tuple[str, Callable[[], Found]]]:
        """Of one arm, from above."""
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
        """Of a surface that encloses a volume."""
        if not self.mesh.is_closed:
            raise _NotThere("the template is open, so it has no volume")
        return Weight()

    def point(self, *names: str) -> Carried:
        """The mean of landmarks, all of which must be there."""
        for name in names:
            self.places.at(name)
        return mean_of(*(self.places.of[name] for name in names))

    def loop(self, origin: np.ndarray, normal: np.ndarray) -> SectionCurve:
        """The closed section by a plane that is nearest to a point (3,) of it, at most 12 cm away."""
        curves = section(self.mesh.vertices, self.mesh.faces, origin, normal)
        far = [np.linalg.norm(curve.at(self.mesh.vertices).mean(axis=0) - origin) for curve in curves]
        if not curves or min(far) > 0.12 * self.scale:
            raise _NotThere("the template has no section there")
        best = curves[int(np.argmin(far))]
        if not best.closed:
            raise _NotThere("a hole of the template crosses it")
        return best

    def level(self, near: np.ndarray, height: float) -> tuple[np.ndarray, np.ndarray]:
        """The level plane at a height, metres, through the point above or below `near` (3,)."""
        up = self.places.up
        return near + (height - near @ up) * up, up

    def along(self, start: np.ndarray, end: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
        """The plane across the line between two points (3,)."""
        return start + share * (end - start), (end - start) / np.linalg.norm(end - start)

    def keep(self, name: str, plane: tuple[np.ndarray, np.ndarray] | None, axis: tuple[Carried, Carried] | None,
             band: float = 0.07, under_arms: bool = False) -> Girth:
        """The girth in a plane (a point of it, its normal), or across an axis where that begins; carried by its
        centroid.
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
        far, _ = self.graph.nearest(np.unique(ring.edges))
        near = (far <= band * self.scale)[self.mesh.faces].any(axis=1)
        if under_arms:
            near &= ~self.arms[self.mesh.faces].any(axis=1)
        aside = 1 if "upper_arm" in name else -1 if "thigh" in name else 0
        self.done[name] = Girth(centre, axis, self.mesh.faces[near], ring, under_arms, aside)
        return self.done[name]

    @cached_property
    def arms(self) -> np.ndarray:
        """(N,) bool, the vertices of the arms: nearer to the elbow, along the surface, than the armpit is.

        And of the shoulders: above the armpit and farther out, where a tape at the nipples comes on some bodies.
        """
        found = np.zeros(len(self.mesh.vertices), dtype=bool)
        for side, sign in (("left", 1), ("right", -1)):
            elbow, armpit = (self.places.of.get(f"{side} {name}") for name in ("elbow inside", "armpit"))
            if elbow is not None and armpit is not None:
                far = self.graph.distances(elbow)
                up, left, _ = self.places.axes @ (self.mesh.vertices - self.mesh.vertices[armpit]).T
                found |= (far < far[armpit]) | ((up > 0) & (sign * left > 0))
        return found

    def girth(self, name: str) -> Girth:
        """One that was found before."""
        if name not in self.done:
            raise _NotThere(f"the template has no {name.replace('_', ' ')}")
        return self.done[name]

    def extreme(self, name: str, sign: int, plane: Callable[[float], tuple[np.ndarray, np.ndarray]],
                axis: tuple[Carried, Carried] | None = None, band: float = 0.07) -> Girth:
        """The girth of the longest (1) or shortest (-1) tape among 25 planes, over t from 0 to 1."""
        planes = [plane(float(t)) for t in np.linspace(0, 1, 25)]
        lengths = [sign * self.around(self.loop(*at), at[1]) for at in planes]
        return self.keep(name, planes[int(np.argmax(lengths))], axis, band)

    def around(self, ring: SectionCurve, normal: np.ndarray) -> float:
        """Metres of a tape around a section."""
        points = ring.at(self.mesh.vertices)
        hull = points[tape(points, normal)]
        return float(np.linalg.norm(hull - np.roll(hull, 1, axis=0), axis=1).sum())

    def trunk(self, name: str, height: float) -> Girth:
        """A level girth of the trunk."""
        return self.keep(name, self.level(self.middle(), height), None, BAND, name != "waist_girth")

    def middle(self) -> np.ndarray:
        """A point (3,) on the axis of the trunk."""
        p = self.places
        if "back" in p.of:
            return p.at("navel", "back")
        return p.at("left hip", "right hip", "left shoulder", "right shoulder")

    def waist(self) -> Girth:
        """At the landmarks, else the narrowest of the trunk."""
        p = self.places
        if {"left waist", "right waist"} <= set(p.of):
            return self.trunk("waist_girth", p.height("left waist", "right waist"))
        low, high = p.height("crotch"), p.height("left nipple", "right nipple")
        return self.extreme("waist_girth", -1, lambda t: self.level(
            self.middle(), low + (0.35 + 0.5 * t) * (high - low)), None, BAND)

    def hips(self) -> Girth:
        """The widest from the crotch up to two thirds of the way to the waist."""
        p = self.places
        low, high = p.height("crotch"), p.height("left waist", "right waist", "navel")
        return self.extreme("hip_girth", 1, lambda t: self.level(
            self.middle(), low + (0.12 + 0.55 * t) * (high - low)), None, BAND)

    def neck(self) -> Girth:
        """The narrowest across the neck, which leans forward: over planes that sink towards the throat, too.

        Level ones run into the jaw of people who hold their chins low.
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
            with contextlib.suppress(_NotThere):
                tried.append(leaning(lean))
        if not tried:
            raise _NotThere("the template has no whole neck")
        self.done["neck_girth"] = min(tried, key=lambda one: one[0])[1]
        return self.done["neck_girth"]

    def limb(self, name: str, start: np.ndarray, end: np.ndarray, first: float, second: float
             ) -> tuple[Carried, Carried]:
        """The axis of a limb: centroids of two sections between its ends."""
        low, high = (self.loop(*self.along(start, end, share)).centroid(self.mesh.vertices)
                     for share in (first, second))
        self.limbs[name] = low, high
        return low, high

    def upper_arm(self, side: str) -> tuple[Carried, Carried]:
        """From its middle, or as soon as the armpit is passed, to the elbow."""
        p = self.places
        for share in (0.5, 0.56, 0.62, 0.68):
            with contextlib.suppress(_NotThere):
                return self.limb(f"{side} upper arm", p.at(f"{side} shoulder"),
                                 p.at(f"{side} elbow outside", f"{side} elbow inside"), share, 0.95)
        raise _NotThere("the upper arm lies against the trunk on the template")

    def shin(self, side: str) -> tuple[Carried, Carried]:
        p = self.places
        return self.limb(f"{side} shin", p.at(f"{side} knee", f"{side} knee inside"), p.at(f"{side} heel"), 0.0, 0.7)

    def span(self, girth: str, axis: int) -> Span:
        self.girth(girth)
        return Span(girth, axis)

    def behind(self, girth: Girth, name: str) -> np.ndarray:
        """Vertices of a girth's section that lie beyond its plane, seen from a landmark, so that a way crosses it.

        Where triangles are as long as a forearm those before it are anywhere on the way.
        """
        vertices = self.mesh.vertices
        normal = self.places.up if girth.axis is None else direction(girth.axis, vertices)
        ring, origin = np.unique(girth.ring.edges), girth.centre.at(vertices)
        side = np.sign((self.point(name).at(vertices) - origin) @ normal)
        return ring[side * ((vertices[ring] - origin) @ normal) < 0]

    def nearest(self, girth: Girth, name: str) -> int:
        """The vertex behind a girth that is nearest to a landmark, along the surface."""
        ring = self.behind(girth, name)
        return int(ring[self.graph.distances(self.point(name).vertices[0])[ring].argmin()])

    def at_back(self, girth: Girth, name: str) -> int:
        """The vertex behind a girth in the middle of the back."""
        ring = self.behind(girth, name)
        apart = self.mesh.vertices[ring] - girth.centre.at(self.mesh.vertices)
        back = apart @ self.places.axes[2] < 0
        return int(ring[back][np.abs(apart[back] @ self.places.axes[1]).argmin()])

    def way(self, *stations: str | int, until: str | None = None) -> Way:
        """Along the surface, over landmarks or vertices, and as far as the plane of a girth."""
        vertices = [int(self.point(s).vertices[0]) if isinstance(s, str) else s for s in stations]
        faces = []
        for start, end in itertools.pairwise(vertices):
            over = self.graph.distances(np.array([start, end])).sum(axis=0)        # of ways over each vertex
            if not np.isfinite(over[start]):
                raise _NotThere("no way along the surface joins its ends")
            # triangles count that a way crosses which is up to 5 cm longer than the shortest
            faces.append(self.mesh.faces[(over[self.mesh.faces] <= over[start] + 0.05 * self.scale).any(axis=1)])
        return Way(tuple(vertices), tuple(faces), until)

    def foot(self, side: str) -> Extent:
        """From heel to toes, of what is low and on that side."""
        p = self.places
        heel, toe = self.point(f"{side} heel"), self.point(f"{side} toe")
        middle = 0.5 * (p.at(f"{side} heel") + p.at(f"{side} toe"))
        low = self.mesh.vertices @ p.up - self.floor < 0.05 * self.scale
        near = np.linalg.norm(self.mesh.vertices - middle, axis=1) < 0.2 * self.scale
        own = (self.mesh.vertices - 0.5 * (p.at("left heel") + p.at("right heel"))) @ p.axes[1]
        return Extent(np.flatnonzero(low & near & ((own > 0) == (side == "left"))), heel, toe)
