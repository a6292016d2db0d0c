"""The distorted lens through which colour and depth are shown besides."""

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator

from datagen.scene_spec.base import Spec


def _is_magnification(value: Any) -> Any:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if value != "cover" and not (is_number and 0.1 <= value <= 10):
        raise ValueError('expected a number from 0.1 to 10, or "cover"')
    return value


Magnification = Annotated[float | Literal["cover"], BeforeValidator(_is_magnification)]


class LensSettings(Spec):
    """A lens of the Brown-Conrady model, its coefficients as OpenCV's: radial k1, k2, k3, tangential p1, p2.

    k4, k5 and k6 are the denominator of OpenCV's rational model. What it shows lies beside the undistorted images as
    the layers ``distorted_color`` and ``distorted_depth``. The lens may look past the rendered image, where there is
    nothing to show: ``magnification`` is its focal length over the rendered camera's, and ``cover`` takes the
    smallest that leaves no pixel empty.
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    magnification: Magnification = 1.0
