"""`rhp driver`: the drivers of robot and tracker as a process of their own."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from rhp_drake.commands import task_run


def driver(
    file: Annotated[
        Path,
        typer.Argument(
            help="Says where robot and tracker are; or a bundled name, e.g. "
            "virtual_lab."
        ),
    ],
) -> None:
    """Drives the robot and the tracker of a file for whoever plans over LCM.

    `rhp run SCENARIO --hardware lcm` plans, on this computer, or on another if the
    file's `lcm.url` says so.  Ctrl-C stops the arm and ends.
    """
    # Drake is imported here, so that `rhp --help` is quick.
    from pydrake.lcm import DrakeLcm

    from rhp_drake.drivers.lcm_config import LcmConfig
    from rhp_drake.hardware import load_hardware, running_hardware
    from rhp_drake.lcm_bridge import LcmBridge
    from rhp_drake.safety import Fault, describe
    from rhp_drake.station.ur5_kinematics import DhDeltas

    config = load_hardware(file)
    lcm = config.lcm or LcmConfig()
    objects = config.natnet.bodies
    console = task_run.make_console()
    if config.kinematics != DhDeltas():
        # The messages have joints, not the hand.
        console.print(
            "Whoever plans needs this file's `kinematics` in its own file, too."
        )
    console.print(f"Connecting to {config.description or file}")
    fault = Fault.NONE
    try:
        with running_hardware(replace(config, lcm=None), len(objects)) as hardware:
            bridge = LcmBridge(
                DrakeLcm(lcm.url),
                hardware.arm,
                hardware.tracker,
                objects,
                config.ur.command_timeout,
            )
            task_run.say_motion(console, dry_run=config.ur.dry_run)
            console.print(f"At {lcm.url}.  Ctrl-C stops the arm and ends.")
            while True:
                new_fault = bridge.step()
                if new_fault != fault:
                    fault = new_fault
                    console.print(f"The arm was stopped: {describe(fault)}")
                    console.print("It stays so until this command is started anew.")
    except KeyboardInterrupt:
        console.print("The arm is stopped.")
