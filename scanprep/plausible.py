"""What no person is and no scan of one shows, asked alike by every command: size, build, shape, unit.

Each question returns a judgement or a reason in words, with the likely cause, or None.
"""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .geometry.mesh import Mesh
from .judgement import Judgement, extent

# ANSUR II, 6,068 soldiers: 1.41 to 1.99 m, 36 to 144 kg, 15 to 43 kg/m²; a litre of a person weighs about a kilogram.
# The population varies more than soldiers: bodies beyond 1.40 to 2.10 m or 35 to 200 litres need a look.
ADULTS, VOLUMES = (1.40, 2.10), (35.0, 200.0)          # metres, litres
# litres per square metre of stature: beyond the first range a look is needed, beyond the second nobody is so built;
# 400 synthetic people have 14 to 31, a body completed from the scan of a chair 8.6
BUILD, ANY_BUILD = (13.0, 55.0), (9.0, 90.0)
# The squared length of K betas is chi-square distributed. ONE_OF: one person in this number is beyond the first limit,
# which is 7.0 for 18 betas. USUAL: the limit is at least this times the root of K. Completions of people reach 1.4
# times that root, those of a chair and a cylinder, which other limits refuse, 2.1 and 2.3. TOO_LONG: the second limit
# is this times the first. `mosh` with a model of other people finds up to 12 for 18 betas where the motion is right
# but the body is not; recordings scaled by 1.6 and 2.54 end at 20 and 46.
ONE_OF, USUAL, TOO_LONG = 10_000, 1.6, 1.8
# Metres: a toddler of one year, and taller than almost anybody. Children below an adult's size need a look.
ANYBODY = (0.65, 2.30)
WRONG_UNIT = "the wrong unit or scale? (--unit, or --unit unknown)"


class WrongScaleError(ValueError):
    """A scan shows a person of a size that nobody has: its unit is another one."""


def implausible_body(stature: float, volume: float | None = None, betas: np.ndarray | None = None, cause: str = ""
                     ) -> Judgement:
    """Judge whether a person can have such a body, with the likely cause where not.

    Parameters
    ----------
    stature : float, metres
        Height of the body.
    volume : float, litres, optional
        Volume of the body.
    betas : (K,) float, standard deviations, optional
        Shape coefficients.
    cause : str
        Why the body may be implausible, where that is known; by default the causes for scans and recordings.

    Returns
    -------
    Judgement

    Examples
    --------
    >>> implausible_body(1.75, 74.0, np.ones(10)).verdict
    'good'
    >>> implausible_body(2.61, 290.0).reasons[0]
    'the person is 2.61 m tall: the wrong unit or scale? (--unit, or --unit unknown)'
    """
    failed, check = [], []
    if not ANYBODY[0] <= stature <= ANYBODY[1]:
        failed.append(f"the person is {stature:.2f} m tall: {cause or WRONG_UNIT}")
    elif not ADULTS[0] <= stature <= ADULTS[1]:
        who = "a child" if stature < ADULTS[0] else "a giant"
        check.append(f"the person is {stature:.2f} m tall: {cause or f'{who}, or {WRONG_UNIT}'}")
    if volume is not None and not failed:
        # build: volume relative to stature, as the body-mass index
        build = volume / stature**2
        little = "flattened, or something else than a person?"
        words = f"the person has {volume:.0f} litres at {stature:.2f} m"
        if not ANY_BUILD[0] <= build <= ANY_BUILD[1]:
            what = "something else than a person, or several?" if build > BUILD[0] else little
            failed.append(f"{words}, as nobody has: {cause or what}")
        elif not BUILD[0] <= build <= BUILD[1] or (stature >= ADULTS[0] and not VOLUMES[0] <= volume <= VOLUMES[1]):
            much = "clothes, a second person, or the wrong scale?"
            check.append(f"{words}: {cause or (much if build > BUILD[0] else little)}")
    if betas is not None and len(betas):
        # length of the betas: their root mean square is 1 in the population
        length, usual = float(np.linalg.norm(betas)), float(np.sqrt(len(betas)))
        most = longest_betas(len(betas))
        words = f"the shape is {length:.0f} standard deviations from the mean, {usual:.0f} are usual"
        if length > TOO_LONG * most:
            failed.append(f"{words}: {cause or 'something else than a person, or the wrong scale?'}")
        elif length > most:
            check.append(f"{words}: {cause or 'a body that the model does not know, or markers that stand off?'}")
    return Judgement.of(failed, check)


def longest_betas(count: int) -> float:
    """Compute the largest plausible length of betas, standard deviations: at most one person in `ONE_OF` is beyond.

    [MoSh] Eq. 20
    """
    from scipy.special import gammainccinv

    return float(np.sqrt(max(2 * gammainccinv(count / 2, 1 / ONE_OF), USUAL**2 * count)))


def too_fast(speed: float, size: float) -> str | None:
    """Return that markers or joints of a person move too fast, by their median speed, m/s; None if they do not.

    `size` is that of the body: the root of the area of its skin, metres.
    """
    # 5 sizes a second, 7 m/s on a man. Walking has 1, running 4; a walk with ten times its rate 12, one with shuffled
    # frames 15. Noise of a millimetre moves a marker by 0.05 m/s.
    return f"the markers move at {speed:.0f} m/s: frames in another order, or the wrong rate?" \
        if speed > 5.0 * size else None


def falls_otherwise(falls: Sequence[float]) -> str | None:
    """Return that a person falls faster or slower than gravity makes it, by accelerations in flights; None if not.

    Examples
    --------
    >>> falls_otherwise([0.09, 0.1])
    'in 2 jumps the body falls with 0.1 m/s², gravity has 9.8: the wrong rate, or the wrong scale?'
    """
    # ten jumps of one person and the somersault of another have 9.0 to 9.8 m/s²
    if not len(falls) or 0.6 <= float(np.median(falls)) / 9.81 <= 1.6:
        return None
    jumps = "a jump" if len(falls) == 1 else f"{len(falls)} jumps"
    return (f"in {jumps} the body falls with {float(np.median(falls)):.2g} m/s², gravity has 9.8: the wrong rate, or "
            "the wrong scale?")


def impossible_walk(stride: float, behind: float) -> str | None:
    """Return that nobody walks at such a pace, by the seconds of a gait cycle and the balance; None if somebody may.

    `behind` is how far the extrapolated centre of mass is behind the heel of the standing foot, metres, as the other
    one leaves the floor (Hof et al. 2005). Somebody slow who puts the weight on the foot first, as in tai chi, has less
    than 0.

    Examples
    --------
    >>> impossible_walk(11.0, 0.03)
    'a walk with a gait cycle of 11 s would fall backwards at every step: the wrong rate?'
    """
    # sprinters have 0.4 s; the slowest patients with a walking frame 3 s. The centre of mass of a walk is 0.27 m ahead
    # of the heel, at half its rate 0.1 m, at a tenth 0.03 m behind
    if stride < 0.35:
        return f"a walk with a gait cycle of {stride:.2f} s: the wrong rate?"
    return f"a walk with a gait cycle of {stride:.0f} s would fall backwards at every step: the wrong rate?" \
        if stride > 3.0 and behind > 0 else None


def upside_down(heights: np.ndarray, axis: str) -> str | None:
    """Return that a person stands on the head, by heights (T,) of the head above the feet along an axis of the file.

    A handstand is a part of a recording.

    Examples
    --------
    >>> upside_down(np.full(9, -1.5), "z")
    'the head is below the feet along z in all frames: upside down, lying, or an axis of the wrong sign?'
    """
    return f"the head is below the feet along {axis} in all frames: upside down, lying, or an axis of the wrong sign?" \
        if len(heights) and float(np.mean(heights < 0)) > 0.98 else None


def another_layout(known: int, off: float, name: str, known_by_name: int, off_by_name: float, gain: float
                   ) -> str | None:
    """Return that a named layout explains a recording better than the one that was given; None if it does not.

    Parameters
    ----------
    known, known_by_name : int
        Labels that the given layout and the named one know.
    off, off_by_name : float, metres
        How far these markers are beside their places, in the mean.
    name : str
        Of the other layout.
    gain : float
        Energy of its fit, per marker, as a share of that of the given one.

    Examples
    --------
    >>> another_layout(39, 0.031, "cmu41", 41, 0.020, 0.66)
    'cmu41 explains 41 labels, 20 mm beside its places; this layout 39, 31 mm beside its own: another layout?'
    """
    # 0.75: sets of the same labels on two people have 0.38 to 0.68, and 0.83 where two sets are nearly the same
    if known_by_name < known or gain > 0.75:
        return None
    return (f"{name} explains {known_by_name} labels, {1000 * off_by_name:.0f} mm beside its places; this layout "
            f"{known}, {1000 * off:.0f} mm beside its own: another layout?")


def unequal_scale(stretch: float) -> str | None:
    """Return that a recording is scaled along one axis, by how many times longer it should be there; None if it fits.

    Examples
    --------
    >>> unequal_scale(1.18)
    "the recording is 15% too short along the body, against the other axes: one axis in another scale?"
    """
    # 12 people in 20 spans have 0.97 to 1.07, at 0.85 of their height 1.12 to 1.25, at 1.18 of it 0.83 to 0.90
    if 0.93 <= stretch <= 1.10:
        return None
    share = f"{100 * abs(1 / stretch - 1):.0f}% too {'short' if stretch > 1 else 'long'}"
    return f"the recording is {share} along the body, against the other axes: one axis in another scale?"


def check_unit(scan: Mesh | np.ndarray, body: np.ndarray, what: str) -> None:
    """Raise WrongScaleError for a scan that cannot show a body (N, 3), metres, before minutes of work on it.

    A hand has a tenth of a body's size, and a room around it five times that size. `what` is the subject of the
    sentence.
    """
    points = scan.vertices if isinstance(scan, Mesh) else scan
    if problem := unit_problem(extent(points), extent(body), what, 1 / 30, 10):
        raise WrongScaleError(problem)


def unit_problem(found: float, expected: float, what: str, least: float = 0.2, most: float = 2.5) -> str | None:
    """Return why data `found` metres large, for a body of `expected` metres, are in another unit; None if they are not.

    `what` is the subject of the sentence; `least` and `most` are the smallest and the largest share of a body's extent
    that the data may have.
    """
    if not np.isfinite(found) or least <= found / expected <= most:
        return None
    return (f"{what} {found:.3g} m from corner to corner, {found / expected:.3g} times as large as the body: the wrong "
            "unit? (--unit)")
