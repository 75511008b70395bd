"""Gymnasium's door: importing it registers the environments, as `gymnasium.make("tableverse_factory.gym:…")` does."""

from tableverse_factory.delivery.learning.environment import ENVIRONMENT_ID

__all__ = ["ENVIRONMENT_ID"]
