"""Other rolls of the limbs of a registration: by how much each would have to turn about its own bone.

A limb that is rolled wrongly lies where it should; its skin alone sits elsewhere around the bone. So every limb turns
about its own bone while its bone stays, and a joint is as people do when the rolls of the two parts that meet there
fit together. Joints form a tree: the best rolls of all limbs are found exactly, from the ends to the root.
"""
from __future__ import annotations

import numpy as np

from ..geometry import rotations
from ..synthetic.people import PARENTS, PARTS
from .limbs import GRAVE, LIMBS, ROLL, angle_limits, angles_of_joint, frames
from .person import PersonParts

STEPS = 24                             # rolls that are tried, all round
CHANGE = 0.5                           # what a roll by half a turn costs; a doubt costs one and more
FORCED = tuple(np.radians((90, -90, 180)))      # of a doubted limb, where no joint tells by how much


def other_rolls(parts: PersonParts, R: np.ndarray, doubted: list[int], most: int) -> list[np.ndarray]:
    """At most so many sets of rolls (16,), radians, under which joints are more as people do, the likeliest first.

    World rotations R (16, 3, 3) bring the template onto the scan. The first set is the best of all, if any joint asks
    for one; the others turn a doubted limb by a quarter or by half, the rest as suits it best. Only doubted limbs, what
    hangs on them and what they hang on are rolled.
    """
    limbs = [part for part in doubted if part in LIMBS]
    hanging = {part for part in LIMBS if parts.skeleton.descends[part, limbs].any()}
    free = hanging | {PARENTS[part] for part in limbs if PARENTS[part] in LIMBS}
    costs = joint_costs(R @ parts.R_template_rest)
    forced = [best_rolls(costs, free, part, step(angle)) for part in limbs for angle in FORCED]
    ranked = [best_rolls(costs, free), *sorted(forced, key=lambda found: found[0])]
    kept: list[np.ndarray] = []
    for _, rolls in ranked:
        if rolls.any() and not any(np.array_equal(rolls, other) for other in kept):
            kept.append(rolls)
    return [2 * np.pi / STEPS * np.where(rolls > STEPS // 2, rolls - STEPS, rolls) for rolls in kept[:most]]


def step(angle: float) -> int:
    """The number of a roll by an angle, radians."""
    return round(angle / (2 * np.pi) * STEPS) % STEPS


def joint_costs(R: np.ndarray) -> np.ndarray:
    """What joint j costs (16, STEPS, STEPS), when its parent and its own part roll by two of the steps.

    World rotations R (16, 3, 3) are against the rest of the synthetic people.
    """
    turns = 2 * np.pi / STEPS * np.arange(STEPS)
    low, high = angle_limits()
    costs = np.zeros((len(PARTS), STEPS, STEPS))
    for part in range(1, len(PARTS)):
        above, own = (R[p] @ rotations.exp(turns[:, None] * frames()[p, 0]) for p in (PARENTS[part], part))
        angles = angles_of_joint(part, above[:, None], own[None])
        beyond = np.maximum(low[part] - angles, angles - high[part]).max(axis=-1)
        middle, half = (high[part, ROLL] + low[part, ROLL]) / 2, (high[part, ROLL] - low[part, ROLL]) / 2
        # what a joint costs that is rolled as far as people can
        costs[part] = (0.5 * np.minimum(((angles[..., ROLL] - middle) / half) ** 2, 1)
                       + np.where(beyond > 0, 1 + beyond / GRAVE, 0))
    return costs


def best_rolls(costs: np.ndarray, free: set[int], forced: int = 0, to: int = 0) -> tuple[float, np.ndarray]:
    """The steps (16,) by which the free parts roll at the least cost, and that cost; one may be `forced` to a step."""
    turned = np.minimum(np.arange(STEPS), STEPS - np.arange(STEPS))
    own = np.broadcast_to(CHANGE * turned / (STEPS / 2), (len(PARTS), STEPS)).copy()
    for part in range(len(PARTS)):
        if part not in free or part == forced:
            own[part, np.arange(STEPS) != (to if part == forced else 0)] = np.inf
    choice = np.zeros((len(PARTS), STEPS), dtype=int)
    for part in range(len(PARTS) - 1, 0, -1):                    # a parent comes before its children
        total = costs[part] + own[part]
        choice[part] = total.argmin(axis=1)
        own[PARENTS[part]] += total.min(axis=1)
    rolls = np.zeros(len(PARTS), dtype=int)
    for part in range(1, len(PARTS)):
        rolls[part] = choice[part, rolls[PARENTS[part]]]
    return float(own[0, 0]), rolls
