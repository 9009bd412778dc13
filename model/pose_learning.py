from .learning.pose import *  # noqa: F403
