"""Key dimensions of what was found: flange faces, pipes, extents, fitted to raw points and held against the design."""

from scanfind.dimensions.features import Feature, features_of
from scanfind.dimensions.measure import Plan, dimensioned, plan_of

__all__ = ["Feature", "Plan", "dimensioned", "features_of", "plan_of"]
