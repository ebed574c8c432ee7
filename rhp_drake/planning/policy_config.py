"""The policies a scenario can name, as plain data, and how they are made."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
import math
import re
from typing import TYPE_CHECKING, Final, TypeAlias, assert_never

from rhp_drake.errors import InputError
from rhp_drake.planning.policy import Policy

if TYPE_CHECKING:
    from rhp_drake.planning.open_loop import Planner

DEFAULT_Q_NETWORK: Final = "package://rhp_drake/q_network/best.safetensors"


@dataclass(kw_only=True)
class RecedingHorizonConfig:
    """RHP (section VI of the paper).

    Attributes:
        num_roll_outs: n, at least 1.
        horizon: h, at least 1.
        temperature: tau > 0 of the soft-max, in actions.
        q_network: File of the weights.
        rescue: Whether a plan takes over in a state that RHP has been in before.
    """

    num_roll_outs: int = 6
    horizon: int = 6
    temperature: float = 0.5
    q_network: str = DEFAULT_Q_NETWORK
    rescue: bool = False

    def validate(self) -> None:
        """Raises an `InputError` that names the first impossible value."""
        _check_look_ahead(self.num_roll_outs, self.horizon)
        if not 0 < self.temperature < math.inf:
            raise InputError(
                f"policy.temperature is {self.temperature}; it must be above 0 and "
                "finite."
            )


@dataclass(kw_only=True)
class GreedyConfig:
    """GP: the action of the highest value; RHP with h = 0.

    Attributes:
        q_network: File of the weights.
        rescue: Whether a plan takes over in a state that GP has been in before.
    """

    q_network: str = DEFAULT_Q_NETWORK
    rescue: bool = False

    def validate(self) -> None:
        """Nothing can be impossible."""


@dataclass(kw_only=True)
class OpenLoopConfig:
    """KDP: one plan of the kinodynamic RRT, executed blindly.

    Attributes:
        time_limit: Of the planning, s, above 0.
    """

    time_limit: float = 120.0

    def validate(self) -> None:
        """Raises an `InputError` if the limit is impossible."""
        _check_time_limit(self.time_limit)


@dataclass(kw_only=True)
class CheckedPlanConfig:
    """KDP that looks: it plans anew once the scene is not as its plan expects.

    Attributes:
        time_limit: Of each planning, s, above 0.
        tolerance: How far a body may be from where the plan expects it, m, at least
            0.  After one push in the station a box is 2 mm away from there on average
            and 6 mm at the 95th percentile (`rhp bench model-gap`): 1 cm lets such
            errors pass, until they add up to a sixth of a goal region's radius.
    """

    time_limit: float = 120.0
    tolerance: float = 0.01

    def validate(self) -> None:
        """Raises an `InputError` that names the first impossible value."""
        _check_time_limit(self.time_limit)
        if not 0 <= self.tolerance < math.inf:
            raise InputError(
                f"policy.tolerance is {self.tolerance}; it must be at least 0 and "
                "finite."
            )


@dataclass(kw_only=True)
class RandomConfig:
    """Any allowed action, all equally likely."""

    def validate(self) -> None:
        """Nothing can be impossible."""


@dataclass(kw_only=True)
class PredictiveSamplingConfig:
    """Predictive sampling with a cost made by hand; needs no network.

    Attributes:
        num_roll_outs: n, at least 1: the plan and n - 1 mutations of it.
        horizon: h, at least 1.
    """

    num_roll_outs: int = 6
    horizon: int = 6

    def validate(self) -> None:
        """Raises an `InputError` that names the first impossible value."""
        _check_look_ahead(self.num_roll_outs, self.horizon)


@dataclass(kw_only=True)
class MppiConfig:
    """Model predictive path integral control, as `PredictiveSamplingConfig`.

    Attributes:
        num_roll_outs: n, at least 1.
        horizon: h, at least 1.
    """

    num_roll_outs: int = 6
    horizon: int = 6

    def validate(self) -> None:
        """Raises an `InputError` that names the first impossible value."""
        _check_look_ahead(self.num_roll_outs, self.horizon)


def _check_look_ahead(num_roll_outs: int, horizon: int) -> None:
    for name, value in (("num_roll_outs", num_roll_outs), ("horizon", horizon)):
        if value < 1:
            raise InputError(f"policy.{name} is {value}; it must be at least 1.")


def _check_time_limit(value: float) -> None:
    if not 0 < value < math.inf:
        raise InputError(
            f"policy.time_limit is {value}; it must be above 0 and finite."
        )


PolicyConfig: TypeAlias = (
    RecedingHorizonConfig
    | GreedyConfig
    | OpenLoopConfig
    | CheckedPlanConfig
    | RandomConfig
    | PredictiveSamplingConfig
    | MppiConfig
)

# Policies by short names: those of the paper's Table I, KDP that looks, policies that
# are got out of loops, and some that need no learning.  The latter, but for chance,
# simulate as many actions a decision as rhp66.
POLICIES: Final[dict[str, Callable[[], PolicyConfig]]] = {
    "kdp": OpenLoopConfig,
    "gp": GreedyConfig,
    "rhp33": partial(RecedingHorizonConfig, num_roll_outs=3, horizon=3),
    "rhp66": partial(RecedingHorizonConfig, num_roll_outs=6, horizon=6),
    "kdp_checked": CheckedPlanConfig,
    "gp_rescue": partial(GreedyConfig, rescue=True),
    "rhp33_rescue": partial(
        RecedingHorizonConfig, num_roll_outs=3, horizon=3, rescue=True
    ),
    "rhp66_rescue": partial(RecedingHorizonConfig, rescue=True),
    "random": RandomConfig,
    "ps66": partial(PredictiveSamplingConfig, num_roll_outs=6, horizon=6),
    "mppi66": partial(MppiConfig, num_roll_outs=6, horizon=6),
}

# Policies that look ahead, by the beginnings of names such as rhp12x8.
_FAMILIES: Final[dict[str, Callable[..., PolicyConfig]]] = {
    "rhp": RecedingHorizonConfig,
    "ps": PredictiveSamplingConfig,
    "mppi": MppiConfig,
}
_SIZED_NAME: Final = re.compile(rf"({'|'.join(_FAMILIES)})([1-9][0-9]*)x([1-9][0-9]*)")


def named_policy(name: str) -> PolicyConfig:
    """The policy that a short name means.

    Args:
        name: One of `POLICIES`, or rhp<n>x<h>, ps<n>x<h> or mppi<n>x<h> for n roll-outs
            of h actions.

    Raises:
        InputError: If it means none.
    """
    if name in POLICIES:
        return POLICIES[name]()
    sized = _SIZED_NAME.fullmatch(name)
    if sized is None:
        raise InputError(
            f"{name!r} is no policy; there are {', '.join(POLICIES)}, and with n "
            "roll-outs of h actions rhp<n>x<h>, ps<n>x<h> and mppi<n>x<h>."
        )
    family, num_roll_outs, horizon = sized.groups()
    return _FAMILIES[family](num_roll_outs=int(num_roll_outs), horizon=int(horizon))


def MakePolicy(
    config: PolicyConfig,
    num_objects: int,
    num_threads: int = 1,
    planner: "Planner | None" = None,
) -> Policy:
    """Makes the policy, with its own push model, for m = `num_objects`.

    Args:
        config: Which policy.
        num_objects: m.
        num_threads: Of its push model; more are faster and decide the same.
        planner: Of policies that execute plans; None for the kinodynamic RRT.

    Raises:
        InputError: If a value is impossible, or the weights are missing, corrupt or
            for another m.
    """
    from rhp_drake.planning.checked_plan import CheckedPlan
    from rhp_drake.planning.kinodynamic_rrt import plan
    from rhp_drake.planning.open_loop import OpenLoop
    from rhp_drake.planning.random_policy import Random
    from rhp_drake.planning.receding_horizon import RecedingHorizon
    from rhp_drake.planning.rescue import Rescued
    from rhp_drake.planning.sampling_mpc import Mppi, PredictiveSampling
    from rhp_drake.push_model.transition import PushModel
    from rhp_drake.resources import resolve
    from rhp_drake.value.weights import load_q_network

    config.validate()
    if isinstance(config, RandomConfig):
        return Random()
    push_model = PushModel(num_objects, num_threads)
    if isinstance(config, OpenLoopConfig):
        return OpenLoop(push_model, config.time_limit, planner or plan)
    if isinstance(config, CheckedPlanConfig):
        return CheckedPlan(
            push_model, config.time_limit, config.tolerance, planner or plan
        )
    if isinstance(config, PredictiveSamplingConfig):
        return PredictiveSampling(push_model, config.num_roll_outs, config.horizon)
    if isinstance(config, MppiConfig):
        return Mppi(push_model, config.num_roll_outs, config.horizon)
    if not isinstance(config, GreedyConfig | RecedingHorizonConfig):
        assert_never(config)
    q_network = load_q_network(resolve(config.q_network), num_objects)
    if isinstance(config, GreedyConfig):
        policy = RecedingHorizon(push_model, q_network, 0, 0, 1.0)
    else:
        policy = RecedingHorizon(
            push_model,
            q_network,
            config.num_roll_outs,
            config.horizon,
            config.temperature,
        )
    return Rescued(policy, push_model, q_network) if config.rescue else policy
