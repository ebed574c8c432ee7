"""The policies a scenario can name, as plain data, and how they are made."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
import math
from typing import TYPE_CHECKING, Final, TypeAlias

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
        for name in ("num_roll_outs", "horizon"):
            if getattr(self, name) < 1:
                raise InputError(
                    f"policy.{name} is {getattr(self, name)}; it must be at least 1."
                )
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


def _check_time_limit(value: float) -> None:
    if not 0 < value < math.inf:
        raise InputError(
            f"policy.time_limit is {value}; it must be above 0 and finite."
        )


PolicyConfig: TypeAlias = (
    RecedingHorizonConfig | GreedyConfig | OpenLoopConfig | CheckedPlanConfig
)

# Policies by short names: those of the paper's Table I, KDP that looks,
# and policies that are got out of loops.
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
}


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
    from rhp_drake.planning.receding_horizon import RecedingHorizon
    from rhp_drake.planning.rescue import Rescued
    from rhp_drake.push_model.transition import PushModel
    from rhp_drake.resources import resolve
    from rhp_drake.value.weights import load_q_network

    config.validate()
    if isinstance(config, OpenLoopConfig):
        return OpenLoop(
            PushModel(num_objects, num_threads), config.time_limit, planner or plan
        )
    if isinstance(config, CheckedPlanConfig):
        return CheckedPlan(
            PushModel(num_objects, num_threads),
            config.time_limit,
            config.tolerance,
            planner or plan,
        )
    q_network = load_q_network(resolve(config.q_network), num_objects)
    push_model = PushModel(num_objects, num_threads)
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
