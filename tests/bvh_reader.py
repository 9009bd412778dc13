"""A reader of BVH of its own, to hold against what is written."""
import numpy as np

from scanprep.geometry import rotations


class Bvh:
    """A BVH file, read word by word."""

    def __init__(self, text):
        head, motion = text.split("MOTION\nFrames:")
        self.names, self.parents, self.offsets, self.channels, self.ends, above = [], [], [], [], {}, [-1]
        words = iter(head.split())
        assert next(words) == "HIERARCHY"
        for word in words:
            if word in ("ROOT", "JOINT", "End"):
                named = next(words)
                if word != "End":
                    self.names.append(named)
                    self.parents.append(above[-1])
                assert next(words) == "{" and next(words) == "OFFSET"
                offset = np.array([float(next(words)) for _ in range(3)])
                if word == "End":
                    self.ends[self.names[above[-1]]] = offset
                else:
                    self.offsets.append(offset)
                    assert next(words) == "CHANNELS"
                    self.channels.append([next(words) for _ in range(int(next(words)))])
                above.append(len(self.names) - 1)
            else:
                assert word == "}"
                above.pop()
        count, first, second, self.time, *numbers = motion.split()
        assert (first, second) == ("Frame", "Time:") and above == [-1]
        self.frames = np.array(numbers, dtype=float).reshape(int(count), -1)
        assert self.frames.shape[1] == sum(map(len, self.channels))

    def positions(self, frame):
        """name -> place of the joint, each channel multiplied on from the right."""
        values, world = iter(self.frames[frame]), []
        for parent, offset, channels in zip(self.parents, self.offsets, self.channels, strict=True):
            R, place = world[parent] if parent >= 0 else (np.eye(3), np.zeros(3))
            place = place + R @ offset
            for channel in channels:
                step = next(values) * np.eye(3)["XYZ".index(channel[0])]
                if channel.endswith("position"):
                    place = place + R @ step
                else:
                    R = R @ rotations.exp(np.radians(step))
            world.append((R, place))
        return {name: place for name, (_, place) in zip(self.names, world, strict=True)}
