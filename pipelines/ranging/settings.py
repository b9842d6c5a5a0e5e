"""Settings of the range filter: noise, gate, and every reading of the paper by name."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal, NamedTuple, Self

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


class Flow(StrEnum):
    """How the state is carried over an interval (21), (22)."""

    EXACT = "exact"
    RK4 = "rk4"
    """One Runge-Kutta step, as the paper's text says."""
    EULER = "euler"
    """(21) as printed: the integrand is frozen at the start of the interval."""


class TransitionForm(StrEnum):
    """How A (28) is written."""

    EXACT = "exact"
    FIRST_ORDER = "first-order"
    """I + F dt, the appendix put right."""
    AS_PRINTED = "as-printed"
    """The appendix: V ξ dt / f in A[0,0]."""


class GainForm(StrEnum):
    """How G (29) is written."""

    EXACT = "exact"
    FIRST_ORDER = "first-order"
    """G_c dt, the appendix put right."""
    WITHOUT_DT = "without-dt"
    """G_c with (x - c_x)²: 1/dt too large for Q_c / dt."""
    PLUS_CENTRE = "plus-centre"
    """G_c dt with (x + c_x)² in G[0,0]."""
    AS_PRINTED = "as-printed"
    """The appendix: no dt and (x + c_x)²."""


EXACT, RK4, EULER = range(3)
FIRST_ORDER, AS_PRINTED = 1, 2
GAIN_FIRST_ORDER, GAIN_WITHOUT_DT, GAIN_PLUS_CENTRE, GAIN_AS_PRINTED = range(1, 5)


class Model(NamedTuple):
    """The settings and the camera as the kernels take them; the forms are positions in their enumerations."""

    focal_px: float
    centre_x_px: float
    centre_y_px: float
    q_omega: float
    q_speed: float
    flow: int
    transition: int
    noise_gain: int
    gate: float
    reset_after: int
    reset_factor: float
    xi_floor: float
    xi_ceiling: float
    relinearisations: int


class FilterSettings(BaseModel):
    """Every default of the range filter by name; unknown keys are an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    sigma_omega: NotNegative = Field(1e-3, description="spectral density of the gyro's noise, rad/s/√Hz (17)")
    sigma_speed: NotNegative = Field(1e-2, description="spectral density of the odometer's noise, m/s/√Hz (17)")
    pixel_sigma: Positive = Field(0.5, description="noise of an image point per axis, px: 0.5 KLT, 0.1 chessboard (18)")
    flow: Flow = Field(Flow.EXACT, description="how the state is carried over an interval (21)")
    transition: TransitionForm = Field(TransitionForm.EXACT, description="how A is written (28)")
    noise_gain: GainForm = Field(GainForm.EXACT, description="how G is written (29)")
    gate: Positive | Literal["off"] = Field(13.8, description="an innovation of larger NIS is rejected; or off")
    reset_after: Annotated[int, Field(ge=0)] = Field(3, description="rejections in a row that reset; 0: never")
    reset_factor: Positive = Field(100.0, description="a reset multiplies the variance of ξ, up to 1/nearest_m²")
    xi_floor: Positive = Field(1e-3, description="ξ is not let below, 1/m; its variance is left as it is")
    nearest_m: Positive = Field(0.1, description="1/ξ is not let below, m, so that a wrong ξ does not end the track")
    relinearisations: Annotated[int, Field(ge=0, le=10)] = Field(
        0, description="passes of the lag-1 relinearised prediction; 0: none"
    )

    def model(self, focal_px: float, centre_px: tuple[float, float] = (0.0, 0.0)) -> Model:
        """These settings with a camera, for the kernels.

        Raises:
            ValueError: the focal length is not positive.
        """
        if not focal_px > 0.0:
            raise ValueError(f"focal_px must be positive, not {focal_px}")
        return Model(
            focal_px=float(focal_px),
            centre_x_px=float(centre_px[0]),
            centre_y_px=float(centre_px[1]),
            q_omega=self.sigma_omega**2,
            q_speed=self.sigma_speed**2,
            flow=list(Flow).index(self.flow),
            transition=list(TransitionForm).index(self.transition),
            noise_gain=list(GainForm).index(self.noise_gain),
            gate=float("inf") if self.gate == "off" else float(self.gate),
            reset_after=self.reset_after,
            reset_factor=self.reset_factor,
            xi_floor=self.xi_floor,
            xi_ceiling=1.0 / self.nearest_m,
            relinearisations=self.relinearisations,
        )

    @classmethod
    def plain(cls, **changes: object) -> Self:
        """The bare filter (23)-(29) without gate and reset, for studies of the equations."""
        return cls.model_validate({"gate": "off", "reset_after": 0, **changes})
