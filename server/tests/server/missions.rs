//! The missions that tests and benchmarks fly, as canonical JSON.

use prost_reflect::{DynamicMessage, MessageDescriptor};
use serde_json::{Value, json};
use vbar_proto::{DESCRIPTORS, v1};

/// EnviSat as in `simulator/missions/envisat.json`; [Quartullo2025a, sec. V.B] does not give the
/// docking geometry, that file says where this one comes from.
pub(crate) fn envisat() -> Value {
    json!({ "variableHorizon": {
        "hill": {
            "semiMajorAxisM": 7_140_000.0,
            "sampleAngleDeg": 0.351_562_5,
            "accelerationMaxMS2": 0.025,
            "frame": "FRAME_RTN",
            "capturePointM": CAPTURE_POINT_M,
            "cone": { "halfAngleDeg": 25.0 },
            "rotation": { "spin": { "angularVelocityDegS": [
                -0.012_886_816_699_805_652, -1.134_039_869_582_897_3, -0.605_680_384_890_865_5
            ] } },
            "disturbance": { "misalignment": { "angleMaxDeg": 1.0 } },
        },
        "scheme": "VARIABLE_HORIZON_SCHEME_ADAPTIVE_TERMINAL",
        "gain": { "poles": { "values": [0.6, 0.6, 0.6, 0.5, 0.5, 0.5] } },
        "fuelWeight": 5.0,
        "search": "HORIZON_SEARCH_LOCAL",
        "horizonMax": 60,
    } })
}

const CAPTURE_POINT_M: [f64; 3] =
    [1.474_154_351_327_17, -0.143_966_243_873_253_66, 0.236_944_443_041_396_6];

/// 50 m out on the docking axis, at rest relative to the rotating axis.
pub(crate) fn envisat_start() -> Value {
    json!({
        "relative": {
            "frame": "FRAME_RTN",
            "positionM": [49.138_478_377_572_34, -4.798_874_795_775_122, 7.898_148_101_379_887_5],
            "velocityMS": [
                -0.207_055_376_102_783_18, -0.517_672_169_955_497_7, 0.973_663_964_514_608_1
            ],
        },
        "elapsedS": 0.0,
    })
}

/// The double integrator of [Quartullo2025b, sec. 4.1].
#[allow(dead_code, reason = "the benchmarks share this file and fly only EnviSat")]
pub(crate) fn double_integrator() -> Value {
    json!({ "variableHorizon": {
        "linear": {
            "a": { "rows": 2, "columns": 2, "values": [1.0, 1.0, 0.0, 1.0] },
            "b": { "rows": 2, "columns": 1, "values": [0.0, 1.0] },
            "inputLower": [-2.0],
            "inputUpper": [2.0],
            "stateSet": {
                "normals": {
                    "rows": 4, "columns": 2,
                    "values": [1.0, 0.0, -1.0, 0.0, 0.0, 1.0, 0.0, -1.0],
                },
                "offsets": [25.0, 25.0, 2.0, 2.0],
            },
            "disturbance": { "box": { "halfWidthNd": [0.1, 0.4] } },
        },
        "scheme": "VARIABLE_HORIZON_SCHEME_ADAPTIVE_TERMINAL",
        "gain": { "explicit": { "rows": 1, "columns": 2, "values": [-0.06, -0.5] } },
        "fuelWeight": 1.0,
        "trackingWeight": 0.02,
        "search": "HORIZON_SEARCH_ENUMERATION",
        "horizonMax": 60,
    } })
}

/// Prisma in 5 hours with 6 instants, as in `tests/golden/disturbance_feedback`, made a mission in
/// space and time: orientation and epoch are made up.
#[allow(dead_code, reason = "the benchmarks share this file and fly only EnviSat")]
pub(crate) fn prisma() -> Value {
    json!({ "disturbanceFeedback": {
        "orbit": {
            "elements": {
                "semiMajorAxisM": 7_011_000.0,
                "eccentricity": 0.004,
                "trueAnomalyDeg": 0.0,
                "inclinationDeg": 98.2,
                "raanDeg": 30.0,
                "argumentOfPerigeeDeg": 77.0,
                "frame": "INERTIAL_FRAME_EME2000",
            },
            "epoch": { "calendar": "2027-03-01T12:00:00", "timeSystem": "TIME_SYSTEM_UTC" },
        },
        "initial": { "relative": {
            "frame": "FRAME_LVLH_CCSDS",
            "positionM": [10_000.0, 0.0, 0.0],
            "velocityMS": [0.0, 0.0, 0.0],
        } },
        "targetState": {
            "frame": "FRAME_LVLH_CCSDS",
            "positionM": [330.0, 0.0, 30.0],
            "velocityMS": [0.0, 0.0, -0.0158],
        },
        "instants": { "equalTime": { "count": 6, "durationS": 18_000.0 } },
        "deltaVMaxMS": 0.26,
        "navigationErrors": [
            { "radii": { "positionRadiusM": 0.02, "velocityRadiusMS": 0.002 } },
        ],
        "metric": "ARRIVAL_METRIC_SCALED_6",
        "fuelWeight": 1.0,
    } })
}

/// The same in 6000 s with 10 instants and another limit.
#[allow(dead_code, reason = "the benchmarks share this file and fly only EnviSat")]
pub(crate) fn prisma_6000_s(delta_v_max_m_s: f64) -> Value {
    let mut problem = prisma();
    let method = &mut problem["disturbanceFeedback"];
    method["instants"] = json!({ "equalTime": { "count": 10, "durationS": 6_000.0 } });
    method["deltaVMaxMS"] = delta_v_max_m_s.into();
    problem
}

/// The planned state of the first instant, as if measured at instant `k` of Prisma.
#[allow(dead_code, reason = "the benchmarks share this file and fly only EnviSat")]
pub(crate) fn prisma_measurement(k: u32) -> Value {
    json!({
        "relative": {
            "frame": "FRAME_LVLH_CCSDS",
            "positionM": [10_000.0, 0.0, 0.0],
            "velocityMS": [0.0, 0.0, 0.0],
        },
        "elapsedS": 3_600.0 * f64::from(k),
    })
}

/// A row-major matrix.
#[allow(dead_code, reason = "the benchmarks share this file and fly only EnviSat")]
pub(crate) fn matrix(rows: &[&[f64]]) -> Value {
    let values: Vec<f64> = rows.iter().flat_map(|row| row.iter().copied()).collect();
    json!({ "rows": rows.len(), "columns": rows[0].len(), "values": values })
}

#[allow(dead_code, reason = "the benchmarks share this file and fly only EnviSat")]
pub(crate) fn diagonal(entries: &[f64]) -> Value {
    let n = entries.len();
    let mut values = vec![0.0; n * n];
    entries.iter().enumerate().for_each(|(i, entry)| values[i * n + i] = *entry);
    json!({ "rows": n, "columns": n, "values": values })
}

/// |x_i| <= sizes[i], for the components from `first` on of `n`.
#[allow(dead_code, reason = "the benchmarks share this file and fly only EnviSat")]
pub(crate) fn symmetric(n: usize, first: usize, sizes: &[f64]) -> Value {
    let mut values = vec![0.0; 2 * sizes.len() * n];
    for i in 0..sizes.len() {
        values[i * n + first + i] = 1.0;
        values[(sizes.len() + i) * n + first + i] = -1.0;
    }
    json!({
        "normals": { "rows": 2 * sizes.len(), "columns": n, "values": values },
        "offsets": ([sizes, sizes].concat()),
    })
}

/// A double integrator of uncertain strength with a set of first steps.
#[allow(dead_code, reason = "the benchmarks share this file and fly only EnviSat")]
pub(crate) fn integrator() -> Value {
    let column = matrix(&[&[0.5], &[1.0]]);
    let uniform = json!({ "uniform": { "low": -0.02, "high": 0.02 } });
    json!({ "offlineSampling": {
        "polynomial": {
            "a": { "constant": matrix(&[&[1.0, 1.0], &[0.0, 1.0]]) },
            "b": { "constant": column, "terms": [{ "powers": [1], "matrix": column }] },
            "parameters": [{ "uniform": { "low": -0.1, "high": 0.1 } }],
            "discretisation": "DISCRETISATION_NONE",
        },
        "disturbance": [uniform, uniform],
        "scheme": "OFFLINE_SAMPLING_SCHEME_OFFLINE_SAMPLING",
        "horizon": 4,
        "gain": { "lqr": { "state": diagonal(&[1.0, 1.0]), "input": diagonal(&[0.5]) } },
        "weights": { "state": diagonal(&[1.0, 1.0]), "input": diagonal(&[0.5]), "samples": 100 },
        "stateSet": symmetric(2, 0, &[4.0, 1.5]),
        "inputSet": symmetric(1, 0, &[1.0]),
        "samples": { "violation": 0.05, "confidenceComplement": 1e-3, "size": 200 },
        "redundancy": { "exact": {} },
        "firstStepSet": { "rounds": 20, "directions": 40, "facetsMax": 300 },
        "seed": "11",
    } })
}

/// The message that `json` writes.
pub(crate) fn message<M: prost::Message + prost::Name + Default>(json: Value) -> M {
    let message = DynamicMessage::deserialize(descriptor::<M>(), json);
    message.expect("JSON of this message").transcode_to().expect("the same contract")
}

/// The JSON of `message`.
#[allow(dead_code, reason = "the benchmarks share this file and send messages only")]
pub(crate) fn json<M: prost::Message + prost::Name + Default>(message: &M) -> Value {
    let mut dynamic = DynamicMessage::new(descriptor::<M>());
    dynamic.transcode_from(message).expect("the same contract");
    serde_json::to_value(dynamic).expect("a message of the contract")
}

fn descriptor<M: prost::Name>() -> MessageDescriptor {
    DESCRIPTORS.get_message_by_name(&M::full_name()).expect("a message of the contract")
}

/// The state that `prediction` says will be measured next if no disturbance acts.
#[allow(dead_code, reason = "the benchmarks share this file and fly only EnviSat")]
pub(crate) fn predicted(answer: &v1::StepResponse, elapsed_s: f64) -> Value {
    predicted_after(answer, 1, elapsed_s)
}

/// The same, `steps` steps on.
#[allow(dead_code, reason = "the benchmarks share this file and fly only EnviSat")]
pub(crate) fn predicted_after(answer: &v1::StepResponse, steps: usize, elapsed_s: f64) -> Value {
    let prediction = answer.prediction.as_ref().expect("it was asked for");
    let row = |matrix: &Option<v1::Matrix>| {
        matrix.as_ref().expect("a spacecraft's").values[3 * steps..][..3].to_vec()
    };
    json!({
        "relative": {
            "frame": "FRAME_RTN",
            "positionM": row(&prediction.positions_m),
            "velocityMS": row(&prediction.velocities_m_s),
        },
        "elapsedS": elapsed_s,
    })
}

/// The mission to the space station of [AguilarMarsillach2022, sec. VI]: approach ellipsoid,
/// keep-out sphere, 20 m box, target. Thresholds are not the paper's, and the safety horizon of the
/// passive phases is as long as a test can afford.
#[allow(dead_code, reason = "the benchmarks share this file and fly only EnviSat")]
pub(crate) fn station() -> Value {
    let passive = |region: Value, within: f64| {
        json!({
            "passive": { "watch": { "region": region, "horizonSteps": 60 } },
            "weights": {
                "stage": { "identityTimes": 1e-6 },
                "input": { "identityTimes": 0.013 },
                "terminal": { "identityTimes": 1e-4 },
            },
            "advanceWithinM": within,
        })
    };
    let near = json!({
        "stage": { "identityTimes": 1e-3 },
        "input": { "identityTimes": 1e-6 },
        "terminal": { "identityTimes": 1e-3 },
    });
    json!({ "abortSafe": {
        "orbit": { "elements": {
            "semiMajorAxisM": 6_726_270.0, "eccentricity": 0.0, "trueAnomalyDeg": 0.0,
        } },
        "massKg": 4000.0,
        "sampleTimeS": 30.0,
        "frame": "FRAME_RTN",
        "thrusters": { "cubeCorners": { "forceMaxN": 20.0 } },
        "phases": [
            passive(json!({ "semiAxes": { "semiAxesM": [1000.0, 2000.0, 1000.0] } }), 200.0),
            passive(json!({ "radiusM": 100.0 }), 150.0),
            {
                "active": {
                    "watch": {
                        "region": { "halfWidths": { "halfWidthsM": [20.0, 20.0, 20.0] } },
                        "speedMaxMS": 6.0,
                        "horizonSteps": 46,
                    },
                    "modes": { "preset": "FAILURE_MODE_PRESET_SINGLE_THRUSTERS" },
                },
                "weights": near,
                "advanceWithinM": 30.0,
            },
            { "nothingAvoided": {}, "weights": near },
        ],
        "predictionHorizon": 30,
        "fallback": "ABORT_SAFE_FALLBACK_SOFTEN",
        "arrivalDistanceM": 5.0,
        "fastestApproachMS": 5.0,
        "stepsMax": 2000,
    } })
}

/// At rest relative to the station, so far along its orbit.
#[allow(dead_code, reason = "the benchmarks share this file and fly only EnviSat")]
pub(crate) fn at_rest(along_track_m: f64) -> Value {
    json!({ "relative": {
        "frame": "FRAME_RTN",
        "positionM": [0.0, along_track_m, 0.0],
        "velocityMS": [0.0, 0.0, 0.0],
    } })
}
