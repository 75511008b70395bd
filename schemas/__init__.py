"""Contracts between the stages: pydantic where text enters, frozen dataclasses where arrays flow, Arrow at rest."""
