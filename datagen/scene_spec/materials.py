"""What surfaces look like."""

from datagen.scene_spec.base import Color, Fraction, Spec


class MaterialSettings(Spec):
    """A surface of one colour."""

    color: Color
    roughness: Fraction = 0.5
    metallic: Fraction = 0.0
