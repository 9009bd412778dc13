"""Find better rolls for the limbs of a registration: how far each should turn about its own bone.

A twisted limb has the right position, but its skin is rotated about the bone. So every limb may turn about its bone,
which stays. The cost of a joint depends on the rolls of its two parts only. Joints form a tree, so dynamic programming
from the ends to the root finds the best rolls exactly.
"""
from __future__ import annotations

import numpy as np

from ..geometry import rotations
from ..synthetic.people import PARENTS, PARTS
from .limbs import GRAVE, LIMBS, ROLL, angle_limits, angles_of_joint, frames
from .person import PersonParts

STEPS = 24                             # rolls tried per limb, 15 degrees apart
CHANGE = 0.5                           # cost of a roll by half a turn; an implausible joint costs 1 or more
FORCED = tuple(np.radians((90, -90, 180)))      # rolls tried for an implausible limb whose joints do not say how far


def other_rolls(parts: PersonParts, R: np.ndarray, doubted: list[int], most: int) -> list[np.ndarray]:
    """Find at most `most` sets of rolls (16,), radians, that make joints more plausible, the likeliest first.

    World rotations R (16, 3, 3) take the template to the scan. The first set is the best of all, if it is not zero. The
    others force one implausible limb (`doubted`) by a quarter or half turn and optimise the rest. Only implausible
    limbs, their descendants and their parents are rolled.
    """
    limbs = [part for part in doubted if part in LIMBS]
    hanging = {part for part in LIMBS if parts.skeleton.descends[part, limbs].any()}
    free = hanging | {PARENTS[part] for part in limbs if PARENTS[part] in LIMBS}
    # the best set, and the best with each forced roll; sets of zero rolls and duplicates are dropped
    costs = joint_costs(R @ parts.R_template_rest)
    forced = [best_rolls(costs, free, part, step(angle)) for part in limbs for angle in FORCED]
    ranked = [best_rolls(costs, free), *sorted(forced, key=lambda found: found[0])]
    kept: list[np.ndarray] = []
    for _, rolls in ranked:
        if rolls.any() and not any(np.array_equal(rolls, other) for other in kept):
            kept.append(rolls)
    return [2 * np.pi / STEPS * np.where(rolls > STEPS // 2, rolls - STEPS, rolls) for rolls in kept[:most]]


def step(angle: float) -> int:
    """Return the step number of a roll by an angle, radians."""
    return round(angle / (2 * np.pi) * STEPS) % STEPS


def joint_costs(R: np.ndarray) -> np.ndarray:
    """Compute the cost (16, STEPS, STEPS) of each joint for every roll of its parent and of its own part.

    World rotations R (16, 3, 3) are from the rest pose of the synthetic people.
    """
    turns = 2 * np.pi / STEPS * np.arange(STEPS)
    low, high = angle_limits()
    costs = np.zeros((len(PARTS), STEPS, STEPS))
    for part in range(1, len(PARTS)):
        above, own = (R[p] @ rotations.exp(turns[:, None] * frames()[p, 0]) for p in (PARENTS[part], part))
        angles = angles_of_joint(part, above[:, None], own[None])
        beyond = np.maximum(low[part] - angles, angles - high[part]).max(axis=-1)
        middle, half = (high[part, ROLL] + low[part, ROLL]) / 2, (high[part, ROLL] - low[part, ROLL]) / 2
        # at most 0.5 for a roll within the limits; beyond them 1 and more, as the severity of `LimbMeasures.doubts`
        costs[part] = (0.5 * np.minimum(((angles[..., ROLL] - middle) / half) ** 2, 1)
                       + np.where(beyond > 0, 1 + beyond / GRAVE, 0))
    return costs


def best_rolls(costs: np.ndarray, free: set[int], forced: int = 0, to: int = 0) -> tuple[float, np.ndarray]:
    """Find the least cost and the steps (16,) of the free parts; the part `forced` rolls by the step `to`."""
    # cost of each part alone; parts that are not free must keep their roll, the forced one has a fixed step
    turned = np.minimum(np.arange(STEPS), STEPS - np.arange(STEPS))
    own = np.broadcast_to(CHANGE * turned / (STEPS / 2), (len(PARTS), STEPS)).copy()
    for part in range(len(PARTS)):
        if part not in free or part == forced:
            own[part, np.arange(STEPS) != (to if part == forced else 0)] = np.inf
    # upward: the best step of each part for every step of its parent; downward: read the choices
    choice = np.zeros((len(PARTS), STEPS), dtype=int)
    for part in range(len(PARTS) - 1, 0, -1):                    # a parent comes before its children
        total = costs[part] + own[part]
        choice[part] = total.argmin(axis=1)
        own[PARENTS[part]] += total.min(axis=1)
    rolls = np.zeros(len(PARTS), dtype=int)
    for part in range(1, len(PARTS)):
        rolls[part] = choice[part, rolls[PARENTS[part]]]
    return float(own[0, 0]), rolls
