"""Part D: mass and hinge."""

from schemas.curation import PhysicalProperties
from tableverse_factory.physics.bodies.materials import estimate_mass_kg
from tableverse_factory.stages.curate.judge_input import JudgedObject
from tableverse_factory.stages.curate.lexicon import find_hinge_category


def estimate_physical_properties(item: JudgedObject) -> PhysicalProperties:
    """Mass from volume, shell and material, hinge by category."""
    hinge = find_hinge_category(item.label)
    mass = estimate_mass_kg(item.label, item.volume_m3, item.size)
    return PhysicalProperties(mass_kg=round(mass, 5), has_hinge=hinge is not None, hinge_category=hinge)
