"""Documents of a plan, read by others: OCM by `ccsds_ndm`, OEM by `oem`, the compact form from
proto/UPLINK.md alone; every number compared with the plan's JSON.

Usage: ccsds.py http://HOST:PORT
"""

import hashlib
import json
import struct
import sys
import tempfile
import urllib.request
import zlib

import ccsds_ndm
import numpy as np
from oem import OrbitEphemerisMessage

MU_M3_S2 = 3.986004418e14

MISSION = {
    "orbit": {
        "elements": {
            "semiMajorAxisM": 7011000.0,
            "eccentricity": 0.004,
            "trueAnomalyDeg": 0.0,
            "inclinationDeg": 98.2,
            "raanDeg": 30.0,
            "argumentOfPerigeeDeg": 77.0,
            "frame": "INERTIAL_FRAME_EME2000",
        },
        "epoch": {"calendar": "2027-03-01T12:00:00", "timeSystem": "TIME_SYSTEM_UTC"},
    },
    "initial": {
        "relative": {
            "frame": "FRAME_LVLH_CCSDS",
            "positionM": [10000.0, 0.0, 0.0],
            "velocityMS": [0.0, 0.0, 0.0],
        }
    },
    "targetState": {
        "frame": "FRAME_LVLH_CCSDS",
        "positionM": [330.0, 0.0, 30.0],
        "velocityMS": [0.0, 0.0, -0.0158],
    },
    "instants": {"equalTime": {"count": 6, "durationS": 18000.0}},
    "deltaVMaxMS": 0.26,
    "navigationErrors": [{"radii": {"positionRadiusM": 0.02, "velocityRadiusMS": 0.002}}],
}


def call(url, message=None):
    body = None if message is None else json.dumps(message).encode()
    request = urllib.request.Request(url, body, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=60) as answer:
        return answer.read()


def close(found, expected, tolerance, what):
    found, expected = np.asarray(found, float), np.asarray(expected, float)
    error = np.max(np.abs(found - expected))
    assert found.shape == expected.shape and error <= tolerance, (what, error, found, expected)


def matrix(message):
    return np.array(message["values"]).reshape(message["rows"], message["columns"])


def check_ocm(text, plan):
    ocm = ccsds_ndm.from_str(text)
    metadata = ocm.segment.metadata
    assert metadata.object_name == "CHASER", metadata.object_name
    assert str(metadata.time_system).endswith("UTC"), metadata.time_system
    (block,) = ocm.segment.data.man
    assert block.man_ref_frame == "LVLH_ROTATING", block.man_ref_frame
    composition = block.man_composition
    if isinstance(composition, str):
        composition = [word.strip() for word in composition.split(",")]
    assert composition == ["TIME_ABSOLUTE", "MAN_DURA", "DV_X", "DV_Y", "DV_Z"], composition
    assert len(block.man_lines) == len(plan["burns"])
    for line, burn in zip(block.man_lines, plan["burns"]):
        values = [float(value) for value in line.values]
        assert str(line.epoch) == burn["epoch"], (line.epoch, burn["epoch"])
        assert values[0] == 0.0, values
        # 16 digits of km/s.
        close(np.array(values[1:4]) * 1e3, burn["deltaVMS"], 1e-15, "burn")
    print("OCM:", len(block.man_lines), "impulses in", block.man_ref_frame)


def target_state(elements, true_anomaly_deg):
    """Inertial position and velocity of the target."""
    a, e = elements["semiMajorAxisM"], elements["eccentricity"]
    nu = np.radians(true_anomaly_deg)
    i, raan, perigee = (
        np.radians(elements[name]) for name in ("inclinationDeg", "raanDeg", "argumentOfPerigeeDeg")
    )

    def about_z(angle):
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    c, s = np.cos(i), np.sin(i)
    axes = about_z(raan) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ about_z(perigee)
    p = a * (1 - e * e)
    position = p / (1 + e * np.cos(nu)) * np.array([np.cos(nu), np.sin(nu), 0])
    velocity = np.sqrt(MU_M3_S2 / p) * np.array([-np.sin(nu), e + np.cos(nu), 0])
    return axes @ position, axes @ velocity


def inertial(elements, planned):
    """Inertial state of the chaser and its covariance, from a planned state, by hand."""
    r, v = target_state(elements, planned["trueAnomalyDeg"])
    h = np.cross(r, v)
    z, y = -r / np.linalg.norm(r), -h / np.linalg.norm(h)
    axes = np.column_stack([np.cross(y, z), y, z])
    rate = h / (r @ r)
    position = axes @ np.array(planned["state"]["positionM"])
    velocity = axes @ np.array(planned["state"]["velocityMS"]) + np.cross(rate, position)
    spin = np.array([[0, -rate[2], rate[1]], [rate[2], 0, -rate[0]], [-rate[1], rate[0], 0]])
    jacobian = np.block([[axes, np.zeros((3, 3))], [spin @ axes, axes]])
    covariance = jacobian @ matrix(planned["outerShape"]) @ jacobian.T / 8
    return np.concatenate([r + position, v + velocity]), covariance


def check_oem(text, plan):
    ephemeris = opened(text)
    elements = MISSION["orbit"]["elements"]
    segments = list(ephemeris)
    assert len(segments) == len(plan["burns"]), len(segments)
    states = 0
    for k, segment in enumerate(segments):
        assert segment.metadata["REF_FRAME"] == "EME2000"
        arc = list(segment.states)
        covariances = list(segment.covariances)
        assert len(arc) == len(covariances) >= 8
        states += len(arc)
        for state, covariance in zip(arc, covariances):
            assert state.epoch == covariance.epoch
            eigenvalues = np.linalg.eigvalsh(np.asarray(covariance.matrix))
            assert eigenvalues[0] > 0, eigenvalues
        # Just before the next burn.
        planned = plan["states"][k + 1]
        expected, spread = inertial(elements, planned)
        close(np.asarray(arc[-1].position) * 1e3, expected[:3], 1e-5, "position")
        close(np.asarray(arc[-1].velocity) * 1e3, expected[3:], 1e-8, "velocity")
        # What is planned there holds one navigation error more than the covariance.
        found = np.asarray(covariances[-1].matrix) * 1e6
        ratio = np.sqrt(np.trace(found[:3, :3]) / np.trace(spread[:3, :3]))
        assert 0.5 < ratio < 1.1, ratio
        # Just after this one: the same place, and the planned impulse more of velocity.
        planned = dict(plan["states"][k])
        burnt = np.array(planned["state"]["velocityMS"]) + plan["burns"][k]["deltaVMS"]
        planned["state"] = {**planned["state"], "velocityMS": list(burnt)}
        expected, spread = inertial(elements, planned)
        close(np.asarray(arc[0].position) * 1e3, expected[:3], 1e-5, "position after the burn")
        close(np.asarray(arc[0].velocity) * 1e3, expected[3:], 1e-8, "velocity after the burn")
        if k == 0:
            # No correction yet: just after the first burn as just before it.
            scale = np.sqrt(np.outer(np.diag(spread), np.diag(spread)))
            found = np.asarray(covariances[0].matrix) * 1e6
            close(found / scale, spread / scale, 1e-6, "covariance")
    print("OEM:", len(segments), "arcs,", states, "states with covariances")


def opened(text):
    """The reader takes files only."""
    with tempfile.NamedTemporaryFile("w", suffix=".oem") as file:
        file.write(text)
        file.flush()
        return OrbitEphemerisMessage.open(file.name)


def check_binary(content, plan, plan_id):
    """By proto/UPLINK.md."""
    assert hashlib.sha256(content).hexdigest() == plan_id
    assert struct.unpack("<I", content[-4:])[0] == zlib.crc32(content[:-4])
    offset = 0

    def take(form):
        nonlocal offset
        values = struct.unpack_from("<" + form, content, offset)
        offset += struct.calcsize("<" + form)
        return values

    assert take("Q8s") == (8, b"vbarDF\0\1")
    a, e, _ = take("3d")
    assert (a, e) == (7011000.0, 0.004)
    assert take("B") == (1,)
    close(np.degrees(take("3d")), [98.2, 30.0, 77.0], 1e-12, "orientation")
    assert take("BB") == (1, 1)
    (nanoseconds,) = take("q")
    # 9921 days from noon to noon, and TAI is 37 s ahead of UTC.
    assert nanoseconds == (9921 * 86400 + 37) * 10**9, nanoseconds
    assert take("B") == (1,)
    assert take("6d") == (10000.0, 0, 0, 0, 0, 0)
    assert take("6d") == (330.0, 0, 30.0, 0, 0, -0.0158)
    assert take("BQd") == (1, 6, 18000.0)
    assert take("d") == (0.26,)
    assert take("QQQ") == (1, 6, 6)
    close(np.diag(np.reshape(take("36d"), (6, 6))), [4e-4] * 3 + [4e-6] * 3, 1e-18, "errors")
    assert take("BBddB") == (1, 1, 1.0, 0.01, 0)
    for burn in plan["burns"]:
        assert list(take("3d")) == burn["deltaVMS"]
    for gain in plan["gains"]:
        columns = np.reshape(take("18d"), (6, 3))
        assert np.array_equal(columns.T, matrix(gain["gain"]))
    take("BQ")
    assert offset == len(content) - 4, (offset, len(content))
    print("binary:", len(content), "bytes,", len(plan["gains"]), "gains")


def main(url):
    problem = {"disturbanceFeedback": MISSION}
    answer = json.loads(call(f"{url}/v1/plans:compute", {"problem": problem}))
    plan_id, plan = answer["planId"], answer["plan"]["disturbanceFeedback"]

    def export(form):
        return call(f"{url}/v1/plans/{plan_id}:export?format={form}")

    check_ocm(export("CCSDS_OCM").decode(), plan)
    check_oem(export("CCSDS_OEM").decode(), plan)
    check_binary(export("BINARY"), plan, plan_id)


if __name__ == "__main__":
    main(*sys.argv[1:])
