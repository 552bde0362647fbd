//! Computes a plan that corrects for what navigation gets wrong, exports it, and flies it.
//!
//! The mission is Simbol-X [Deaconu2014, table 2]: an approach along one line on a highly elliptic
//! orbit. There is no spacecraft here: each next measurement is the plan's own nominal state, a
//! decimetre off, so that the corrections can be seen.
//!
//! `cargo run -p vbar-client --example plan_and_fly -- http://127.0.0.1:7440 plan.oem`
#![allow(clippy::print_stdout)]

use vbar_client::{
    Client, Error, Options,
    v1::{
        ArrivalMetric, ComputePlanRequest, DisturbanceFeedbackPlan, DisturbanceFeedbackProblem,
        Epoch, EqualInstants, ErrorRadii, ExportPlanRequest, Frame, InertialFrame, InitialState,
        Instants, KeplerianElements, Measurement, NavigationError, PlanFormat, PlannedState,
        Problem, RelativeState, TargetOrbit, TimeSystem, compute_plan_response::Outcome,
        initial_state, instants, measurement, navigation_error, problem, step_response::Verdict,
        step_stream_request::Controller, target_orbit,
    },
};

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let url = arguments.next().unwrap_or_else(|| "http://127.0.0.1:7440".into());
    let file = arguments.next();
    let client = Client::connect(&url, Options::default()).await?;

    let request = ComputePlanRequest { problem: Some(problem()), ..ComputePlanRequest::default() };
    let answer = client.plan(request).await?;
    let plan = match answer.outcome {
        Some(Outcome::Plan(plan)) => plan.disturbance_feedback.unwrap_or_default(),
        Some(Outcome::Infeasible(why)) => {
            println!("no plan exists: {}", why.reason);
            return Ok(());
        }
        None => return Err("the node gave no outcome".into()),
    };
    let axes = plan.arrival.as_ref().map_or(&[][..], |set| &set.position_semi_axes_m);
    println!("plan {}: {:.3} m/s, arrives within {axes:.2?} m", answer.plan_id, plan.fuel_m_s);

    let request = ExportPlanRequest {
        plan_id: answer.plan_id.clone(),
        format: PlanFormat::CcsdsOem.into(),
        ..ExportPlanRequest::default()
    };
    let document = client.export_plan(request).await?;
    match file {
        Some(file) => std::fs::write(file, &document.content)?,
        None => println!("{}", String::from_utf8_lossy(&document.content)),
    }
    fly(&client, answer.plan_id, &plan).await?;
    Ok(())
}

/// Asks for one burn an instant until the node says that the mission has arrived.
async fn fly(
    client: &Client,
    plan_id: String,
    plan: &DisturbanceFeedbackPlan,
) -> Result<(), Error> {
    let mut flight = client.closed_loop(Controller::PlanId(plan_id)).await?;
    for (k, planned) in plan.states.iter().enumerate() {
        // The first measurement is the state that the plan was made for.
        let off_m = if k == 0 { 0.0 } else { 0.1 };
        let answer = flight.step(measured(planned, off_m)).await?;
        match answer.verdict {
            Some(Verdict::Command(burn)) => {
                println!("{:8.1} s  {:9.5?} m/s", burn.elapsed_s, burn.delta_v_m_s);
            }
            Some(Verdict::Arrived(arrival)) => println!(
                "arrived {:.3} m from the target state, inside the guaranteed set: {}",
                arrival.distance_m.unwrap_or_default(),
                arrival.inside_guaranteed_set
            ),
            Some(Verdict::Infeasible(why)) => println!("no burn exists: {}", why.reason),
            Some(Verdict::Abort(_)) | None => println!("the node gave no verdict of a plan"),
        }
    }
    Ok(())
}

/// The nominal state, seen so far to the side.
fn measured(planned: &PlannedState, off_m: f64) -> Measurement {
    let mut state = planned.state.clone().unwrap_or_default();
    if let Some(x) = state.position_m.first_mut() {
        *x += off_m;
    }
    Measurement {
        state: Some(measurement::State::Relative(state)),
        elapsed_s: Some(planned.elapsed_s),
        ..Measurement::default()
    }
}

/// The mission.
fn problem() -> Problem {
    let errors = ErrorRadii { position_radius_m: Some(0.02), velocity_radius_m_s: Some(0.002) };
    let mut mission = DisturbanceFeedbackProblem {
        orbit: Some(orbit()),
        initial: Some(InitialState {
            form: Some(initial_state::Form::Relative(at_rest([-305.0, 0.0, 396.0]))),
        }),
        target_state: Some(at_rest([-60.2, 0.0, 79.85])),
        instants: Some(Instants {
            spacing: Some(instants::Spacing::EqualTime(EqualInstants {
                count: 10,
                duration_s: Some(8000.0),
            })),
        }),
        delta_v_max_m_s: Some(0.8),
        navigation_errors: vec![NavigationError {
            form: Some(navigation_error::Form::Radii(errors)),
        }],
        ..DisturbanceFeedbackProblem::default()
    };
    mission.set_metric(ArrivalMetric::Position);
    Problem { method: Some(problem::Method::DisturbanceFeedback(mission)) }
}

fn orbit() -> TargetOrbit {
    let elements = KeplerianElements {
        semi_major_axis_m: Some(106_246_975.0),
        eccentricity: Some(0.7988),
        true_anomaly_deg: Some(135.0),
        inclination_deg: Some(5.2),
        raan_deg: Some(180.0),
        argument_of_perigee_deg: Some(90.0),
        frame: InertialFrame::Eme2000.into(),
    };
    TargetOrbit {
        form: Some(target_orbit::Form::Elements(elements)),
        epoch: Some(Epoch {
            calendar: "2027-03-01T12:00:00.000".into(),
            time_system: TimeSystem::Utc.into(),
        }),
    }
}

/// Along-track, against the orbit normal, towards the Earth; at rest in the rotating frame.
fn at_rest(position_m: [f64; 3]) -> RelativeState {
    RelativeState {
        frame: Frame::LvlhCcsds.into(),
        position_m: position_m.to_vec(),
        velocity_m_s: vec![0.0; 3],
    }
}
