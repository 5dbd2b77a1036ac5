"""Ten jobs that begin and end with files of other software, each in at most six lines."""

import textwrap
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import lieint_jax as li

TLE = """ISS (ZARYA)
1 25544U 98067A   24061.50000000  .00016717  00000-0  10270-3 0  9005
2 25544  51.6400 208.9163 0006317  69.9862  25.2906 15.49560532    19
"""
ROBOT = """<robot name="arm"><link name="hand"><inertial><origin xyz="0 0 1"/><mass value="2"/>
<inertia ixx="3" iyy="4" izz="5" ixy="0" ixz="0" iyz="0.1"/></inertial></link></robot>"""
TETRAHEDRON = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))
CORNERS = np.array([[0.0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 4]])
PDB = """HETATM    1  O   HOH A   1       0.000   0.000   0.000  1.00  0.00           O
HETATM    2  H1  HOH A   1       0.957   0.000   0.000  1.00  0.00           H
HETATM    3  H2  HOH A   1      -0.240   0.927   0.000  1.00  0.00           H
HETATM    4  O   HOH A   2       2.800   0.000   0.300  1.00  0.00           O
HETATM    5  H1  HOH A   2       3.100   0.900   0.400  1.00  0.00           H
HETATM    6  H2  HOH A   2       3.100  -0.500   1.050  1.00  0.00           H
END
"""

JOBS = {
    "the inertia of a body from the log of its gyro": """
        log = li.files.read_csv_log("gyro.csv", time="t", rates=["x", "y", "z"], units={"rates": "deg/s"})
        def errors(p):
            body = li.systems.RigidBody(jnp.append(p["ratios"], 1.0))
            start = body.state(angular_velocity=p["rate"])
            return (jax.vmap(lambda t: body.angular_velocity(body.solution(start, t)))(log.times) - log.rates) / 0.002
        fit = li.fit(errors, guess, bounds=bounds, standardized=True, progress=False)
    """,
    "attitudes along the orbit of an OEM, as AEM": """
        orbit = li.files.read_oem("sat.oem")
        body = li.systems.gravity_gradient([1.0, 10.0, 10.5], orbit, mu=li.orbits.EARTH_GM)
        start = body.state(angular_velocity=[0.0, 0.0, 1e-3], t=0.0, work=0.0)
        run = li.run(li.schemes.splitting(body), start, 10.0, 90, epoch=orbit.epoch, progress=False)
        li.files.write_aem("sat.aem", run, object=orbit.object)
    """,
    "detumbling along the orbit of a TLE": """
        tle = li.files.read_tle("iss.tle")
        field = li.orbits.earth_field(tle.orbit(3600.0), tle.epoch)
        body = li.systems.torqued_body([0.1, 0.11, 0.08], li.torques.bdot(1e4, field))
        start = body.state(angular_velocity=[0.1, 0.02, 0.05], t=0.0, work=0.0)
        run = li.run(li.schemes.torqued_midpoint(body), start, 5.0, 700, progress=False)
    """,
    "the light curve of a DAMIT shape beside an ALCDEF one": """
        corners, faces = li.shapes.surface("shape.txt")
        seen = li.files.read_light_curves("seen.alcdef")[0]
        body = li.systems.rigid_body(li.shapes.mesh(corners, faces, density=1.0).aligned())
        start, days = body.state(angular_velocity=[0.0, 0.0, 25.0]), seen.dates - seen.dates[0]
        run = li.run(li.schemes.exact(body), start, times=days, progress=False)
        light = li.measure.light_curve(run, li.shapes.facets(corners, faces), [1.0, 0, 0], [1.0, 0.2, 0])
    """,
    "the free flight of a part of a robot": """
        hand = li.files.read_urdf_inertia("arm.urdf", "hand")
        body = li.systems.rigid_body(hand)
        run = li.run(li.schemes.so3_midpoint(body), body.state(angular_velocity=[0.1, 2.0, 0.1]), 0.01, 500, progress=False)
    """,
    "a flyby along a table of Horizons": """
        orbit = li.files.read_horizons("flyby.txt")
        body = li.systems.gravity_gradient([0.6, 0.9, 1.0], orbit, mu=li.orbits.EARTH_GM)
        start = body.state(angular_velocity=[0.0, 0.0, 1e-4], t=0.0, work=0.0)
        run = li.run(li.schemes.splitting(body), start, 60.0, 1000, save_every=100, progress=False)
    """,
    "the energy of a dimer of a PDB": """
        water, dimer = li.potentials.water(), li.files.read_molecules("dimer.pdb", scale=0.1)
        placed = [molecule.superpose(water.points[:3]) for molecule in dimer]
        bodies = li.systems.rigid_bodies([18.0154] * 2, [water.inertia] * 2, water)
        positions, attitudes = [p.position for p in placed], [p.attitude for p in placed]
        energy = bodies.energy(bodies.state(positions, attitudes))
    """,
    "the covariance of a rate from attitudes with the scalar last": """
        log = li.files.read_csv_log("star.csv", time="t", attitudes=["x", "y", "z", "w"], scalar="last")
        body, so3 = li.systems.rigid_body([1.0, 2.0, 3.0]), li.groups.so3
        def errors(rate):
            seen = jax.vmap(lambda t: body.solution(body.state(log.attitudes[0], angular_velocity=rate), t).q)(log.times)
            return jax.vmap(lambda a, b: so3.log(so3.multiply(so3.inverse(a), b)))(seen, jnp.asarray(log.attitudes)) / 1e-4
        fit = li.fit(errors, jnp.array([0.1, 0.0, 0.9]), standardized=True, progress=False)
    """,
    "a run as pandas, CSV and netCDF": """
        body = li.systems.rigid_body([1.0, 2.0, 3.0])
        run = li.run(li.schemes.so3_midpoint(body), body.state(angular_velocity=[0.2, 0, 1]), 0.1, 20, progress=False)
        frame = run.to_dataframe()
        li.files.write_csv("run.csv", run)
        run.to_xarray().to_netcdf("run.nc")
    """,
    "the moments of a body of an STL": """
        body = li.files.read_shape("part.stl", density=2700.0, scale=1e-3)
        moments, axes = body.principal_axes()
    """,
}


def write_files():
    """What each job begins with, made by the exact motion where it is data."""
    Path("iss.tle").write_text(TLE, encoding="utf-8")
    Path("arm.urdf").write_text(ROBOT, encoding="utf-8")
    Path("dimer.pdb").write_text(PDB, encoding="utf-8")
    rng = np.random.default_rng(0)
    body = li.systems.rigid_body([0.6, 0.8, 1.0])
    start, t = body.state(angular_velocity=[0.5, 0.3, 0.4]), np.linspace(0.0, 12.0, 25)
    rates = np.array([body.angular_velocity(body.solution(start, x)) for x in t])
    rows = np.column_stack([t, np.rad2deg(rates + 0.002 * rng.normal(size=rates.shape))])
    np.savetxt("gyro.csv", rows, "%.7f", ",", header="t,x,y,z", comments="")
    body = li.systems.rigid_body([1.0, 2.0, 3.0])
    start, t = body.state(angular_velocity=[0.2, 0.0, 1.0]), np.linspace(0.0, 4.0, 9)
    q = np.array([body.solution(start, x).q for x in t])
    noise = np.array([li.groups.so3.exp(x) for x in 1e-4 * rng.normal(size=(len(t), 3))])
    noise[0] = [1, 0, 0, 0]
    q = np.array([li.groups.so3.multiply(a, b) for a, b in zip(q, noise, strict=True)])
    np.savetxt("star.csv", np.column_stack([t, np.roll(q, -1, axis=1)]), "%.8f", ",", header="t,x,y,z,w", comments="")
    facts = dict(epoch="2024-03-01T12:00:00 UTC", frame="EME2000", center="EARTH", object="SAT")
    li.files.write_oem("sat.oem", circle := li.orbits.kepler(li.orbits.EARTH_GM, 7e3, 0.0, 0.9),
                       times=np.arange(0.0, 1000.0, 20.0), **facts)  # fmt: skip
    assert circle is not None
    hyperbola = li.orbits.kepler(li.orbits.EARTH_GM, -2e4, 2.0, periapsis_time=30_000.0)
    lines = ["Output units    : KM-S", "Center body name: Earth (399)", "Target body name: Rock", "Reference frame : ICRF"]
    lines.append("$$SOE")
    for x in np.arange(0.0, 60_001.0, 120.0):
        r, v = hyperbola(x)
        lines.append(f"{2451545.0 + x / 86400:.9f} = A.D. 2000-Jan-01 12:00:00.0000 TDB ")
        lines.append(" X = {:.15E} Y = {:.15E} Z = {:.15E}".format(*np.asarray(r)))
        lines.append(" VX= {:.15E} VY= {:.15E} VZ= {:.15E}".format(*np.asarray(v)))
    Path("flyby.txt").write_text("\n".join([*lines, "$$EOE", ""]), encoding="utf-8")
    shape = [f"{len(CORNERS)} {len(TETRAHEDRON)}", *(" ".join(map(str, row)) for row in CORNERS)]
    shape += [" ".join(str(k + 1) for k in face) for face in TETRAHEDRON]
    Path("shape.txt").write_text("\n".join([*shape, ""]), encoding="utf-8")
    meta = ["STARTMETADATA", "OBJECTNUMBER=1", "OBJECTNAME=Rock", "FILTER=V", "DELIMITER=PIPE", "ENDMETADATA"]
    meta += [f"DATA={2459000.5 + 0.01 * k:.6f}|{15 + 0.1 * np.sin(k):.3f}|0.010" for k in range(20)] + ["ENDDATA"]
    Path("seen.alcdef").write_text("\n".join([*meta, ""]), encoding="utf-8")
    facets = [f"facet normal 0 0 0\nouter loop\n{'\n'.join('vertex {} {} {}'.format(*CORNERS[k]) for k in face)}\nendloop\nendfacet"
              if False else _facet(face) for face in TETRAHEDRON]  # fmt: skip
    Path("part.stl").write_text("\n".join(["solid part", *facets, "endsolid part", ""]), encoding="utf-8")


def _facet(face):
    corners = [f"vertex {x} {y} {z}" for x, y, z in CORNERS[list(face)]]
    return "\n".join(["facet normal 0 0 0", "outer loop", *corners, "endloop", "endfacet"])
