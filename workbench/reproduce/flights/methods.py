"""The visual odometries that are compared, by name, each built for the camera of a flight."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from pydantic import BaseModel, ValidationError

from pipelines.estimator import Estimator
from workbench.settings import SettingsError

FAST, ACCURATE, BASELINE, KLT = "fast", "accurate", "baseline", "klt"
METHODS = (FAST, ACCURATE, BASELINE, KLT)
"""The two modes of Table 1, the PTAM-style baseline, and OpenCV's KLT with homographies as a peer."""

Values = dict[str, Any]


def built(method: str, camera: Values, **more: Any) -> Estimator[Any]:
    """The estimator of a method.

    Args:
        method: one of `METHODS`.
        camera: values of `CameraSettings`.
        more: settings of its own; those that it does not have are an error, but for `stage_times` of one without.

    Raises:
        SettingsError: there is no such method, or no such setting.
    """
    if method not in _MAKERS:
        raise SettingsError(f"there is no method {method!r}; there are: {', '.join(METHODS)}")
    return _MAKERS[method](method, camera | more)


def chosen(methods: Sequence[str]) -> tuple[str, ...]:
    """These methods in their usual order, each once; all where none is given.

    Raises:
        SettingsError: there is no such method.
    """
    for method in methods:
        if method not in METHODS:
            raise SettingsError(f"there is no method {method!r}; there are: {', '.join(METHODS)}")
    return tuple(method for method in METHODS if not methods or method in methods)


def _semidirect(method: str, values: Values) -> Estimator[Any]:
    from pipelines.semidirect.odometry import SemidirectOdometry
    from pipelines.semidirect.settings import SemidirectSettings

    return SemidirectOdometry(_over(SemidirectSettings.preset(method), values))


def _baseline(method: str, values: Values) -> Estimator[Any]:
    from pipelines.semidirect.baseline import BaselineOdometry
    from pipelines.semidirect.baseline_settings import BaselineSettings

    return BaselineOdometry(_over(BaselineSettings(), values))


def _klt(method: str, values: Values) -> Estimator[Any]:
    from pipelines.semidirect.klt import KltOdometry, KltSettings

    return KltOdometry(_over(KltSettings(), {k: v for k, v in values.items() if k != "stage_times"}))  # it has none


def _over(settings: BaseModel, values: Values) -> Any:
    """The settings with some values changed, validated.

    Raises:
        SettingsError: one that it does not have, or a value that it cannot have.
    """
    try:
        return type(settings).model_validate({**settings.model_dump(), **values})
    except ValidationError as error:
        raise SettingsError(
            f"{type(settings).__name__}: {error.errors()[0]['loc'][0]}: {error.errors()[0]['msg']}"
        ) from error


_MAKERS: dict[str, Callable[[str, Values], Estimator[Any]]] = {
    FAST: _semidirect,
    ACCURATE: _semidirect,
    BASELINE: _baseline,
    KLT: _klt,
}
