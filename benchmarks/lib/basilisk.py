"""A spacecraft in Basilisk: a program for an interpreter that has it (pip install bsk) and needs nothing of ours.

It reads a task {"satellite": …, "dt": …, "steps": …, "longer": …, "runs": …} in JSON and prints the attitude after
`steps` steps of dt by Basilisk's RK4, a quaternion, and the seconds of CPU time of `runs` runs of `longer` more steps
each, in which nothing is logged.
"""

from __future__ import annotations

import json
import sys
import time
from importlib.metadata import version
from typing import Any

EFFECTORS = (
    "GravityGradientEffector",
    "ReactionWheelStateEffector (3 balanced wheels)",
    "MtbEffector",
    "DragDynamicEffector (cannonball)",
    "ExtForceTorque",
)


def spacecraft(satellite: dict[str, Any], dt: float) -> tuple[Any, ...]:
    """A simulation of one spacecraft, the spacecraft, and what must not be collected as garbage."""
    from Basilisk.architecture import messaging  # pyright: ignore[reportMissingImports]
    from Basilisk.simulation import (  # pyright: ignore[reportMissingImports]
        GravityGradientEffector,
        MtbEffector,
        dragDynamicEffector,
        extForceTorque,
        reactionWheelStateEffector,
        spacecraft,
    )
    from Basilisk.utilities import (  # pyright: ignore[reportMissingImports]
        SimulationBaseClass,
        macros,
        simIncludeGravBody,
        simIncludeRW,
    )

    simulation = SimulationBaseClass.SimBaseClass()
    simulation.CreateNewProcess("process").addTask(simulation.CreateNewTask("task", macros.sec2nano(dt)))
    craft = spacecraft.Spacecraft()
    craft.ModelTag = "craft"
    craft.hub.mHub = satellite["mass"]
    craft.hub.IHubPntBc_B = [[J * (i == j) for j in range(3)] for i, J in enumerate(satellite["inertia"])]
    craft.hub.r_CN_NInit, craft.hub.v_CN_NInit = satellite["position"], satellite["velocity"]
    craft.hub.sigma_BNInit, craft.hub.omega_BN_BInit = [[0.0]] * 3, [[x] for x in satellite["angular_velocity"]]
    planets = simIncludeGravBody.gravBodyFactory()
    earth = planets.createEarth()
    earth.isCentralBody, earth.mu = True, satellite["mu"]
    planets.addBodiesTo(craft)

    gradient = GravityGradientEffector.GravityGradientEffector()
    gradient.addPlanetName(earth.planetName)

    wheels, factory = reactionWheelStateEffector.ReactionWheelStateEffector(), simIncludeRW.rwFactory()
    for axis, speed in zip(([1, 0, 0], [0, 1, 0], [0, 0, 1]), satellite["speeds"], strict=True):
        # the factory's model fills in what is not given here
        wheel = factory.create("custom", axis, Js=satellite["wheel"], useMaxTorque=False)
        wheel.Omega, wheel.Omega_max = speed, -1.0
    factory.addToSpacecraft("wheels", wheels, craft)
    motors = messaging.ArrayMotorTorqueMsg().write(
        messaging.ArrayMotorTorqueMsgPayload(motorTorque=satellite["motors"])
    )
    wheels.rwMotorCmdInMsg.subscribeTo(motors)

    bars = MtbEffector.MtbEffector()
    layout = messaging.MTBArrayConfigMsgPayload(
        numMTB=3, GtMatrix_B=[1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0], maxMtbDipoles=[1e3] * 3
    )
    inputs = (
        messaging.MTBCmdMsg().write(messaging.MTBCmdMsgPayload(mtbDipoleCmds=satellite["dipole"])),
        messaging.MTBArrayConfigMsg().write(layout),
        messaging.MagneticFieldMsg().write(messaging.MagneticFieldMsgPayload(magField_N=satellite["field"])),
        messaging.AtmoPropsMsg().write(messaging.AtmoPropsMsgPayload(neutralDensity=satellite["density"])),
    )
    for reader, message in zip((bars.mtbCmdInMsg, bars.mtbParamsInMsg, bars.magInMsg), inputs, strict=False):
        reader.subscribeTo(message)

    drag = dragDynamicEffector.DragDynamicEffector()
    drag.coreParams.projectedArea, drag.coreParams.dragCoeff = satellite["area"], satellite["drag"]
    drag.coreParams.comOffset = satellite["center_of_pressure"]
    drag.atmoDensInMsg.subscribeTo(inputs[3])

    thruster = extForceTorque.ExtForceTorque()
    thruster.extTorquePntB_B = satellite["torque"]

    for effector in (gradient, bars, drag, thruster):
        craft.addDynamicEffector(effector)
    for model in (gradient, wheels, bars, drag, thruster, craft):
        simulation.AddModelToTask("task", model)
    return simulation, craft, (planets, factory, motors, inputs, gradient, wheels, bars, drag, thruster)


def quaternion(sigma: list[float]) -> list[float]:
    """(cos φ/2, e sin φ/2) of modified Rodrigues parameters e tan φ/4."""
    s = sum(x * x for x in sigma)
    return [(1 - s) / (1 + s), *(2 * x / (1 + s) for x in sigma)]


def main() -> None:
    task = json.load(sys.stdin)
    simulation, craft, _held = spacecraft(task["satellite"], task["dt"])
    simulation.InitializeSimulation()

    def advance(steps: int) -> float:
        """Seconds of CPU time."""
        simulation.ConfigureStopTime(simulation.TotalSim.CurrentNanos + steps * round(task["dt"] * 1e9))
        begin = time.process_time()
        simulation.ExecuteSimulation()
        return time.process_time() - begin

    advance(task["steps"])
    q = quaternion(craft.scStateOutMsg.read().sigma_BN)
    seconds = [advance(task["longer"]) for _ in range(task["runs"])]
    print(json.dumps({"version": version("bsk"), "effectors": EFFECTORS, "q": q, "seconds": seconds}))


if __name__ == "__main__":
    main()
