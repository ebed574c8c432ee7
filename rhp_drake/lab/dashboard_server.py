"""A controller's Dashboard Server: one line asks, one line answers.

The answers are those that Universal Robots documents for the CB3.  The commands are
those that make a stopped robot ready again, and what ur_rtde's client needs of others.
"""

import asyncio
from collections.abc import Callable
from typing import Final

from rhp_drake.lab.controller import Controller
from rhp_drake.lab.modes import RuntimeState
from rhp_drake.lab.rtde_server import CONTROLLER_VERSION
from rhp_drake.lab.tcp_server import TcpServer

DASHBOARD_PORT: Final = 29999
_GREETING: Final = "Connected: Universal Robots Dashboard Server"
_VERSION: Final = "URSoftware " + ".".join(map(str, CONTROLLER_VERSION))


class DashboardServer:
    """Serves the dashboard of a controller.

    Args:
        controller: Whose dashboard this is.
        host: Address to listen at, of loopback.

    Raises:
        InputError: If it cannot listen there.
    """

    def __init__(self, controller: Controller, host: str) -> None:
        self._controller = controller
        self._answers: dict[str, Callable[[], str]] = {
            "robotmode": lambda: f"Robotmode: {controller.robot_mode.name}",
            "safetymode": lambda: f"Safetymode: {controller.safety_mode.name}",
            "safetystatus": lambda: f"Safetystatus: {controller.safety_mode.name}",
            "running": self._running,
            "programstate": lambda: f"{controller.runtime_state.name} <unnamed>",
            "polyscopeversion": lambda: _VERSION,
            "get robot model": lambda: "UR5",
            "get loaded program": lambda: "No program loaded",
            "play": self._play,
            "pause": self._pause,
            "stop": self._doing(controller.stop_program, "Stopped"),
            "power on": self._doing(controller.power_on, "Powering on"),
            "power off": self._doing(controller.power_off, "Powering off"),
            "brake release": self._doing(controller.release_brakes, "Brake releasing"),
            "unlock protective stop": self._unlock,
            "restart safety": self._doing(
                controller.restart_safety, "Restarting safety"
            ),
            # There is no screen: nobody has to close what nobody sees.
            "close popup": lambda: "closing popup",
            "close safety popup": lambda: "closing safety popup",
        }
        self._server = TcpServer(host, {DASHBOARD_PORT: self._serve})

    def drop_connections(self) -> None:
        """Cuts all connections; clients may come again."""
        self._server.drop_connections(DASHBOARD_PORT)

    def close(self) -> None:
        """Drops all clients and frees the port.  May be called again."""
        self._server.close()

    async def _serve(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        answer = _GREETING
        while answer != "Disconnected":
            writer.write(answer.encode() + b"\n")
            await writer.drain()
            line = await reader.readline()
            if not line:
                return
            answer = self._answer(line.decode("ascii", "replace").strip())
        writer.write(answer.encode() + b"\n")

    def _answer(self, question: str) -> str:
        if question == "quit":
            return "Disconnected"
        answer = self._answers.get(question.lower())
        return answer() if answer else f"could not understand: '{question}'"

    @staticmethod
    def _doing(function: Callable[[], None], answer: str) -> Callable[[], str]:
        def do() -> str:
            function()
            return answer

        return do

    def _running(self) -> str:
        playing = self._controller.runtime_state == RuntimeState.PLAYING
        return f"Program running: {str(playing).lower()}"

    def _play(self) -> str:
        # A program that was uploaded is not loaded: it can only be resumed.
        resumed = self._controller.resume_program()
        return "Starting program" if resumed else "Failed to execute: play"

    def _pause(self) -> str:
        paused = self._controller.pause_program()
        return "Pausing program" if paused else "Failed to execute: pause"

    def _unlock(self) -> str:
        if self._controller.unlock_protective_stop():
            return "Protective stop releasing"
        return (
            "Cannot unlock protective stop until 5s after occurrence. "
            "Always inspect cause of protective stop before unlocking"
        )
