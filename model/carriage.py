from .learning.carriage import *  # noqa: F403
