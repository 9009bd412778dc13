"""A body that can be posed and reshaped, learned from registered meshes."""
from .fitting import FitConfig, PoseFit, ShapeFit, fit_pose, fit_shape
from .learning import LearnConfig, learn_scape
from .linear import PointOperator, Subject
from .scape import ScapeModel, load_model

__all__ = ["FitConfig", "LearnConfig", "PointOperator", "PoseFit", "ScapeModel", "ShapeFit", "Subject", "fit_pose",
           "fit_shape", "learn_scape", "load_model"]
