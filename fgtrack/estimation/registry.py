"""All estimators and motion models by name, plug-ins included.

An estimator is a class or function `(motion, start, lag_s, **options) -> Estimator`. If it has a true attribute `bank`,
it is `(motion, lag_s, **options) -> TrackBank` instead. A motion model is `(**parameters) -> MotionModel`.
"""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

from fgtrack.core.checks import is_number
from fgtrack.core.errors import CallError
from fgtrack.core.plugins import Alias, Registry
from fgtrack.estimation.base import Estimator, Start, TrackBank
from fgtrack.estimation.filters.initiation import DEFAULT
from fgtrack.estimation.filters.track_initiation import initiated
from fgtrack.estimation.object_bank import ObjectBank, SingleObject
from fgtrack.estimation.repeated import FusedOnce, MeasurementKeeper
from fgtrack.models.motion import MotionModel

OOSM_GROUP = "fgtrack.oosm"
EXACT = "any lag, any number"
_OOSM = "fgtrack.estimation.oosm"
ESTIMATORS = Registry(
    "estimator",
    {
        "fgtrack.estimators": {
            "ekf-backward-forward": "fgtrack.karle2023.backward_forward:backward_forward",
            "ekf-replay": "fgtrack.estimation.filters.replay_bank:ekf_replay",
            "ekf-rts": "fgtrack.estimation.filters.rts_replay:ekf_rts",
            "iekf-replay": "fgtrack.estimation.filters.iekf:IekfReplay",
            "imm-replay": "fgtrack.estimation.filters.imm:ImmReplay",
            "iplf-replay": "fgtrack.estimation.filters.ukf:IplfReplay",
            "smoother": "fgtrack.estimation.smoothing.gtsam.incremental:IncrementalBank",
            "smoother-batch": "fgtrack.estimation.smoothing.gtsam.batch:BatchBank",
            "smoother-banded": "fgtrack.estimation.smoothing.bank:SmootherBank",
            "ukf-replay": "fgtrack.estimation.filters.ukf:UkfReplay",
        },
        OOSM_GROUP: {
            "drop": f"{_OOSM}.late:Drop",
            "as-current": f"{_OOSM}.late:AsCurrent",
            "delayed-horizon": f"{_OOSM}.buffers:DelayedHorizon",
            "reorder-buffer": f"{_OOSM}.buffers:ReorderBuffer",
            "a1": f"{_OOSM}.crossing:A1",
            "b1": f"{_OOSM}.crossing:B1",
            "c": f"{_OOSM}.crossing:C",
            "al1": f"{_OOSM}.crossing:Al1",
            "bl1": f"{_OOSM}.crossing:Bl1",
            "rts": f"{_OOSM}.crossing:RtsCrossCovariance",
            "zlz": f"{_OOSM}.crossing:FixedPoint",
            "asd": f"{_OOSM}.asd:AccumulatedStateDensity",
            "fpfd": f"{_OOSM}.late:Fpfd",
            "ci": f"{_OOSM}.late:CovarianceIntersection",
            "larsen": f"{_OOSM}.crossing:Larsen",
            "rewind-forget": f"{_OOSM}.late:RewindForget",
        },
    },
    aliases={
        "backward-forward": Alias(
            "rewind-forget",
            "It updates at the exact late stamp; the filter of Karle et al. 2023, "
            "on a grid of 10 ms, is 'ekf-backward-forward'.",
        )
    },
)
MOTION_MODELS = Registry(
    "motion model",
    {
        "fgtrack.motion_models": {
            "ctrv": "fgtrack.models.motion:CTRV",
            "ctra": "fgtrack.models.motion:CTRA",
            "ct": "fgtrack.models.motion:CT",
            "cv": "fgtrack.models.motion:CV",
        }
    },
)
Factory = Callable[..., Any]  # Any: an estimator or a bank, see the module


@dataclass(frozen=True)
class Claims:
    """Promises of an estimator, read from attributes of its class or function. A missing attribute has the default."""

    exact: str = ""
    """Late measurements for which the estimate in a linear model is the dense joint posterior of all accepted
    measurements. Empty if there are no such measurements. `fgtrack verify` and `check_estimator` verify `any lag,
    any number`.
    """
    nonlinear: Literal["at once", "at convergence", "never"] = "at once"
    """When the estimates in a nonlinear model become independent of the order of arrival. `at convergence`: after
    the method `converge()` of the estimator or bank. `never`: an estimate keeps its linearisation.
    """
    smooths: bool = False
    """True if later measurements improve states of the past. A filter does not do this."""
    tolerance: float = 1e-9
    """Largest difference from the dense joint posterior, in standard deviations."""
    rounding: float = 0.0
    """Factor on `rounding_bound` of the contract tests, which replaces a smaller tolerance where stamps nearly
    coincide.
    """
    retrodicts: bool = False
    """True if a filter predicts the innovation of a late measurement from all fused measurements, as smoothers do."""
    iterates: bool = False
    """True if the update with a nonlinear measurement is linearised at its own result."""
    spreads: bool = False
    """True if predictions of a nonlinear model are averages over the spread of the state, not values at the mean."""
    mixes: bool = False
    """True if the estimator weighs other motion models beside the given motion model."""
    held_s: float = 0.0
    """Time for which a measurement is held back before it is fused."""
    initiates: bool = False
    """True if the estimator itself estimates an unknown direction of travel, with the option `initiation`. Other
    estimators are wrapped in `Initiated`.
    """
    bank: bool = False
    """True if the factory makes one bank for all objects."""

    @property
    def is_exact(self) -> bool:
        """True if the estimate in a linear model does not depend on which measurements were late."""
        return self.exact == EXACT

    @classmethod
    def of(cls, factory: Factory) -> "Claims":
        """Return the promises that `factory` declares in its attributes. A missing attribute has the default."""
        return cls(
            **{
                f.name: getattr(factory, f.name)
                for f in fields(cls)
                if hasattr(factory, f.name)
            }
        )


def list_estimators(group: str | None = None) -> list[str]:
    """Return the names of all estimators, plug-ins included.

    `group` selects one group of entry points: `fgtrack.estimators`, or `fgtrack.oosm` with the methods for late
    measurements.
    """
    return ESTIMATORS.names(group)


def estimator_claims(name: str) -> Claims:
    """Return the promises of the estimator `name`. Raises `CallError` for an unknown name."""
    return Claims.of(ESTIMATORS.load(name))


# Any: options are the estimator's own.
def estimator(
    name: str, motion: MotionModel, start: Start, *, lag_s: float = 1.0, **options: Any
) -> Estimator:
    """Return the estimator `name` of one object.

    It answers `duplicate` to a measurement that is identical to a fused measurement.

    Parameters
    ----------
    name
        One of `list_estimators()`.
    motion, start
        Motion model, and the state at the first stamp. Older measurements cannot be fused.
    lag_s
        Length of the window behind the newest stamp or the clock.
    options
        Keyword parameters of this estimator. Every estimator has `initiation`, see `Initiation`.

    Raises `CallError` for an unknown name, and for an option that the estimator does not have.
    """
    for what, value, kind in (
        ("name", name, str),
        ("motion", motion, MotionModel),
        ("start", start, Start),
    ):
        if not isinstance(value, kind):
            raise CallError(
                f"{what}: must be a {kind.__name__}, is a {type(value).__name__}"
            )
    if not is_number(lag_s, 0.0):
        raise CallError(
            f"lag_s: must be a number, finite and not negative, is {lag_s!r}"
        )
    one = start_estimator(name, ESTIMATORS.load(name), motion, start, lag_s, options)
    return FusedOnce(one) if isinstance(one, MeasurementKeeper) else one


def start_estimator(
    name: str,
    factory: Factory,
    motion: MotionModel,
    start: Start,
    lag_s: float,
    options: Mapping[str, Any],
) -> Estimator:
    """Return the estimator of one object from a `factory`, which need not be registered.

    `name` is the name of the estimator in messages.
    """
    claims, own = Claims.of(factory), dict(options)
    method = "one-point" if claims.initiates else own.pop("initiation", DEFAULT)

    def made(start: Start) -> Estimator:
        if claims.bank:
            return SingleObject(
                motion,
                _made(ESTIMATORS, TrackBank, name, factory, motion, lag_s, **own),
                start,
                name,
            )
        item: Estimator = _made(
            ESTIMATORS, Estimator, name, factory, motion, start, lag_s, **own
        )
        return item

    return initiated(motion, start, method, made)


def estimator_bank(
    name: str,
    motion: MotionModel,
    lag_s: float,
    options: Mapping[str, Any],
    factory: Factory | None = None,
) -> TrackBank:
    """Return the bank with the estimators `name` of all objects. Raises the exceptions of `estimator`.

    With a `factory` the name need not be registered.
    """
    factory = factory or ESTIMATORS.load(name)
    claims = Claims.of(factory)
    own = {
        key: options[key] for key in options if claims.initiates or key != "initiation"
    }
    if claims.bank:
        bank: TrackBank = _made(
            ESTIMATORS, TrackBank, name, factory, motion, lag_s, **own
        )
        return bank
    _check_options(name, factory, 3, own)
    return ObjectBank(
        motion,
        lambda start: start_estimator(name, factory, motion, start, lag_s, options),
        lag_s,
    )


def motion_model(name: str, parameters: Mapping[str, Any]) -> MotionModel:
    """Return the motion model `name`. Raises `CallError` for an unknown name, and for an unknown parameter."""
    model: MotionModel = _made(
        MOTION_MODELS, MotionModel, name, MOTION_MODELS.load(name), **parameters
    )
    return model


def _made(
    registry: Registry,
    kind: type,
    name: str,
    factory: Factory,
    *arguments: Any,
    **options: Any,
) -> Any:
    """Return the result of the `factory` of `name`. Raises `CallError` unless the result has the members of `kind`."""
    _check_options(name, factory, len(arguments), options)
    with registry.plugin_errors(name, "cannot be made"):
        try:
            made = factory(*arguments, **options)
        except ValueError as error:
            raise CallError(f"{name}: {error}") from error
    if not isinstance(made, kind):
        raise CallError(
            f"{name!r} makes a {type(made).__name__}, which lacks a member of {kind.__name__}"
        )
    return made


def _check_options(
    name: str, factory: Factory, num_arguments: int, options: Mapping[str, Any]
) -> None:
    if not callable(factory):
        raise CallError(
            f"{name}: {factory!r} is not a class or function: correct the entry point"
        )
    signature = inspect.signature(factory)
    try:
        signature.bind(*[None] * num_arguments, **options)
    except TypeError as error:
        taken = list(signature.parameters)[num_arguments:]
        raise CallError(
            f"{name}: {error}; its options are {', '.join(taken) or 'none'}"
        ) from error
