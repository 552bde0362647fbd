//! Plans with disturbance feedback: computed, kept, flown.

use serde_json::{Value, json};
use vbar_proto::v1::ArrivalMetric;
use vbar_simulator::{
    PlanAnswer, PlanCampaign, PlanChanges, PlanMission, PlanReport, PlanRow, PlanRunOptions,
    PlanSummary, Silent, SimulationError, compute_table, draw_plans, fly_plans, plan_rows_json,
    plan_rows_text, plan_text,
};

use super::{mission_text, node};

/// The mission of a file, changed.
fn mission(name: &str, change: impl FnOnce(&mut Value)) -> PlanMission {
    let mut json: Value = serde_json::from_str(&mission_text(name)).expect("JSON");
    change(&mut json);
    PlanMission::parse(&json.to_string()).expect("a mission")
}

/// Flies against a node of its own.
async fn try_fly(
    mission: &PlanMission,
    options: PlanRunOptions,
) -> Result<PlanReport, SimulationError> {
    let (node, client) = node().await;
    let report = fly_plans(&client, mission, &options, &Silent).await;
    node.shutdown().await;
    report
}

async fn fly(name: &str, options: PlanRunOptions) -> PlanReport {
    let mission = mission(name, |_| {});
    try_fly(&mission, options).await.unwrap_or_else(|fault| panic!("{fault}"))
}

fn few(runs: u32) -> PlanRunOptions {
    PlanRunOptions { runs: Some(runs), seed: 1, ..PlanRunOptions::default() }
}

async fn table(name: &str, metric: Option<ArrivalMetric>) -> Vec<PlanRow> {
    let (node, client) = node().await;
    let rows = compute_table(&client, &mission(name, |_| {}), metric).await;
    node.shutdown().await;
    rows.unwrap_or_else(|fault| panic!("{fault}"))
}

/// Everybody arrives inside the promised set, nobody does without corrections.
fn check_guarantee(campaign: &PlanCampaign) {
    let (label, summary) = (campaign.row.mission.label(), PlanSummary::new(campaign));
    let planned = campaign.row.answer.plan().expect("a plan");
    assert!(planned.plan.certificate.as_ref().is_some_and(|proof| proof.passed), "{label}");
    assert_eq!(summary.inside, summary.runs, "{label}: {:?}", summary.metric("position_level"));
    assert!(summary.open_loop_inside < summary.runs, "{label}");
}

/// [Deaconu2014, fig. 2]: every final error belongs to the set; from 10 km with J2 the flights
/// leave the assumed noise set, and the service says so.
#[tokio::test(flavor = "multi_thread")]
async fn prisma_arrives_inside_its_guaranteed_set() {
    let report = fly("prisma.json", few(6)).await;
    assert_eq!(report.campaigns.len(), 2);
    for campaign in &report.campaigns {
        check_guarantee(campaign);
        let summary = PlanSummary::new(campaign);
        assert_eq!(summary.open_loop_inside, 0);
        assert_eq!(summary.outside_assumed_set_runs, 6);
        let gauge = summary.metric("disturbance_gauge").expect("a gauge").max;
        assert!(gauge > 1.0, "{gauge}");
    }
}

/// [Deaconu2014, fig. 3]. At 500 m on an orbit that high the linear model is all but true, so the
/// noise stays in its set too.
#[tokio::test(flavor = "multi_thread")]
async fn simbol_x_arrives_inside_its_guaranteed_set() {
    let report = fly("simbol_x.json", few(6)).await;
    assert_eq!(report.campaigns.len(), 2);
    for campaign in &report.campaigns {
        check_guarantee(campaign);
        let summary = PlanSummary::new(campaign);
        assert_eq!((summary.clipped_burns, summary.outside_assumed_set_runs), (0, 0));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn gto_arrives_inside_its_guaranteed_set() {
    let report = fly("gto.json", few(4)).await;
    assert_eq!(report.campaigns.len(), 3);
    report.campaigns.iter().for_each(check_guarantee);
}

/// The simulator's frames, orbit and impulses are written without guidance's. With perfect
/// measurements what is left at the end is the linear model's own error, which is of second order
/// in the separation and in the angle flown: 0.05 mm on Simbol-X, 6 mm on GTO. A wrong sign, axis
/// or unit would cost metres to hundreds of metres.
#[tokio::test(flavor = "multi_thread")]
async fn perfect_measurements_arrive_where_the_linear_model_says() {
    for (name, limit_m) in [("simbol_x.json", 1e-3), ("gto.json", 0.05)] {
        let mission = mission(name, |m| {
            m["simulation"]["noise"] = "none".into();
            m["simulation"]["truth"]["two_body"]["j2"] = false.into();
            m["simulation"]["flown"] = json!([]);
        });
        let report = try_fly(&mission, few(1)).await.expect("a flight");
        let flight = &report.campaigns[0].flights[0];
        // The truth has been to inertial axes and back: rounding of 1e8 m.
        let start = &flight.samples[0];
        let pairs = start.truth.iter().zip(&start.measured);
        assert!(pairs.into_iter().all(|(is, seen)| (is - seen).abs() < 1e-6), "{start:?}");
        let blind = flight.open_loop.final_distance_m;
        assert!(blind < limit_m, "{name}: {blind} m from the burns alone");
        assert!(flight.final_distance_m < limit_m, "{name}: {} m", flight.final_distance_m);
    }
}

/// [Deaconu2014, table 3] within 0.5 %, with the digits two solvers agree on.
#[tokio::test(flavor = "multi_thread")]
async fn prisma_table_is_the_papers() {
    let rows = table("prisma.json", None).await;
    assert_eq!(rows.len(), 5);
    let PlanAnswer::Infeasible(why) = &rows[0].answer else {
        panic!("0.26 m/s is too little for 6000 s");
    };
    // 0.27887 m/s is what an independent implementation found to be the least.
    let relaxation = why.relaxations.first().expect("a relaxation");
    let least = 0.26 + relaxation.amount_m_s.expect("m/s");
    assert!((least - 0.278_87).abs() < 1e-4, "{least}");
    let expected = [[3.663, 2.839], [5.775, 3.534], [8.766, 4.315], [17.549, 5.430]];
    for (row, axes) in rows[1..].iter().zip(expected) {
        check_axes(row, axes, 5e-3);
        check_open_loop(row);
    }
    let text = plan_rows_text(&rows);
    for part in ["no plan", "17.49", "105.2", "optimal", "0.2788"] {
        assert!(text.contains(part), "{part} is missing in\n{text}");
    }
    let json = plan_rows_json(&rows);
    assert!(json[0]["infeasible"]["reason"].is_string(), "{json:#}");
    assert_eq!(json[4]["published"]["in_plane_semi_axes_m"], json!([17.49, 5.41]));
    let text = plan_text(&rows[4]);
    for part in ["18000", "certificate passed", "burn", "plan "] {
        assert!(text.contains(part), "{part} is missing in\n{text}");
    }
}

/// The open-loop row of [Deaconu2014, table 4]; its other row is not reproduced by anyone: see the
/// mission's description for the digits two solvers agree on.
#[tokio::test(flavor = "multi_thread")]
async fn simbol_x_table_is_the_one_two_solvers_agree_on() {
    let rows = table("simbol_x.json", None).await;
    for (row, axis) in rows.iter().zip([29.41, 38.37, 46.85, 55.07]) {
        check_axes(row, [axis, axis], 5e-3);
        check_open_loop(row);
    }
    // Minimised in metres the set is an order of magnitude smaller.
    let rows = table("simbol_x.json", Some(ArrivalMetric::Position)).await;
    let axes = in_plane(&rows[0]);
    assert!(axes[0] < 3.0, "{axes:?}");
}

fn in_plane(row: &PlanRow) -> Vec<f64> {
    let planned = row.answer.plan().expect("a plan");
    planned.plan.arrival.as_ref().expect("a set").in_plane_semi_axes_m.clone()
}

fn check_axes(row: &PlanRow, expected: [f64; 2], relative: f64) {
    for (ours, theirs) in in_plane(row).into_iter().zip(expected) {
        let label = row.mission.label();
        assert!((ours / theirs - 1.0).abs() < relative, "{label}: {ours} for {theirs}");
    }
}

/// To the printed digits: half a unit of the second decimal, a whole one of the only printed.
fn check_open_loop(row: &PlanRow) {
    let planned = row.answer.plan().expect("a plan");
    let set = planned.plan.open_loop_arrival.as_ref().expect("asked for");
    let paper = row.mission.published.open_loop_axes_m.expect("printed");
    for (ours, theirs) in set.in_plane_semi_axes_m.iter().zip(paper) {
        // The printed 1.4, 0.9, 105.2 and 31.5 have one decimal; ours agree to 0.06 with them.
        assert!((ours - theirs).abs() < 0.06, "{}: {ours} {theirs}", row.mission.label());
    }
}

/// Whatever the number of runs at once, the same seed gives the same report, latencies apart.
#[tokio::test(flavor = "multi_thread")]
async fn plan_flights_do_not_depend_on_concurrency() {
    let with = |concurrency| PlanRunOptions {
        concurrency: std::num::NonZeroUsize::new(concurrency),
        variant: Some("8000s_n6".into()),
        ..few(5)
    };
    let reports = [fly("simbol_x.json", with(1)).await, fly("simbol_x.json", with(4)).await];
    let [alone, crowded] = reports.map(|report| {
        let mut json = report.json();
        let top = json.as_object_mut().expect("an object");
        top.remove("step_latency_ms");
        for plan in top["plans"].as_object_mut().expect("plans").values_mut() {
            plan.as_object_mut().expect("a plan").remove("step_latency_ms");
        }
        json
    });
    assert_eq!(alone, crowded);
}

/// The keys that programs rely on; files and pictures of everything.
#[tokio::test(flavor = "multi_thread")]
async fn plan_report_has_its_keys_files_and_pictures() {
    let options = PlanRunOptions { with_pictures: true, ..few(2) };
    let report = fly("simbol_x.json", options).await;
    let json = report.json();
    for place in [&json, &json["plans"]["8000s"]] {
        for metric in
            ["position_level", "true_position_level", "final_distance_m", "fuel_flown_m_s"]
        {
            for statistic in ["mean", "std", "min", "median", "max"] {
                assert!(place[metric][statistic].is_number(), "{metric}.{statistic}");
            }
        }
        for key in ["runs", "inside_arrival_set", "clipped_burns", "outside_assumed_set_runs"] {
            assert!(place[key].is_number(), "{key}");
        }
        assert!(place["open_loop"]["own_position_level"]["max"].is_number());
        assert!(place["step_latency_ms"]["p50"].is_number());
        assert!(place["plan_id"].is_string());
    }
    assert_eq!(json["table"].as_array().map(Vec::len), Some(4));
    assert!(report.table().contains("inside the arrival set 2 of 2"), "{}", report.table());

    let folder = tempfile::tempdir().expect("a folder");
    let pictures = draw_plans(&report, folder.path()).expect("pictures");
    assert_eq!(pictures.len(), 3, "{pictures:?}");
    for picture in pictures {
        let text = std::fs::read_to_string(&picture).expect("a picture");
        assert!(text.starts_with("<svg") && !text.contains("NaN"), "{picture:?}");
        assert!(text.matches("<poly").count() > 3, "{picture:?} shows nothing");
    }
    let runs = report.write_runs(folder.path()).expect("runs");
    assert_eq!(runs.len(), 2);
    let traces = report.write_traces(folder.path()).expect("traces");
    assert_eq!(traces.len(), 4);
    // A line a run; a line an instant, N = 6 first.
    for (file, lines) in [(&runs[0], 3), (&traces[0], 7), (&traces[2], 11)] {
        let text = std::fs::read_to_string(file).expect("a file");
        let widths: Vec<usize> = text.lines().map(|line| line.split(',').count()).collect();
        assert!(widths.iter().all(|width| *width == widths[0]), "{file:?}: {widths:?}");
        assert_eq!(widths.len(), lines, "{file:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn plan_options_that_do_not_fit_are_refused_by_name() {
    let prisma = mission("prisma.json", |_| {});
    let unknown = PlanRunOptions { variant: Some("moon".into()), ..few(1) };
    let fault = try_fly(&prisma, unknown).await.expect_err("no such variant");
    assert!(fault.to_string().contains("6000s_as_printed"), "{fault}");
    assert!(try_fly(&prisma, few(0)).await.is_err());

    // What only the service can refuse comes back with its field.
    let changes = PlanChanges { delta_v_max_m_s: Some(-1.0), ..PlanChanges::default() };
    let wrong = PlanRunOptions { changes, ..few(1) };
    let fault = try_fly(&prisma, wrong).await.expect_err("a negative bound");
    assert!(fault.to_string().contains("delta_v_max"), "{fault}");
}

/// A variant without a plan is a result, not an error.
#[tokio::test(flavor = "multi_thread")]
async fn plan_that_does_not_exist_is_reported() {
    let options = PlanRunOptions { variant: Some("6000s_as_printed".into()), ..few(2) };
    let report = fly("prisma.json", options).await;
    assert!(report.campaigns[0].flights.is_empty());
    assert!(report.table().contains("no plan"), "{}", report.table());
    assert!(report.json()["infeasible"]["reason"].is_string());
}
