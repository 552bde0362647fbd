//! Flights under abort-safe control: safe and unsafe controllers, failures, phases.

use vbar_simulator::{
    AbortCampaign, AbortMission, AbortOutcome, AbortReport, AbortRunOptions, AbortSummary, Silent,
    SimulationError, fly_aborts,
};

use super::{mission_text, node};

async fn try_fly(name: &str, options: AbortRunOptions) -> Result<AbortReport, SimulationError> {
    let (node, client) = node().await;
    let mission = AbortMission::parse(&mission_text(name)).expect("a mission");
    let report = fly_aborts(&client, &mission, &options, &Silent).await;
    node.shutdown().await;
    report
}

async fn fly(name: &str, options: AbortRunOptions) -> AbortReport {
    try_fly(name, options).await.unwrap_or_else(|fault| panic!("{fault}"))
}

fn variant(name: &str) -> AbortRunOptions {
    AbortRunOptions { variant: Some(name.into()), seed: 1, ..AbortRunOptions::default() }
}

fn mean(campaign: &AbortCampaign, metric: &str) -> f64 {
    let summary = AbortSummary::new(campaign);
    summary.metric(metric).unwrap_or_else(|| panic!("no {metric}")).mean
}

/// [AguilarMarsillach2022, figs. 8, 9]: 13.4 and 20.6 m/s; the independent implementation counts
/// 200 of 213 unsafe states and needs 20.609 m/s after 143 steps.
#[tokio::test(flavor = "multi_thread")]
async fn v_bar_is_safe_where_the_plain_regulator_is_not() {
    let plain = fly("vbar_elliptic.json", variant("unsafe")).await;
    let plain = &plain.campaigns[0];
    assert!((mean(plain, "delta_v_m_s") - 13.4).abs() < 0.1, "{}", mean(plain, "delta_v_m_s"));
    for drift in AbortSummary::new(plain).drifts {
        assert_eq!(drift.states, 213);
        assert!(drift.states_drifting_in.abs_diff(200) <= 5, "{drift:?}");
    }

    let safe = fly("vbar_elliptic.json", variant("safe")).await;
    let safe = &safe.campaigns[0];
    assert!((mean(safe, "delta_v_m_s") - 20.609).abs() < 0.1, "{}", mean(safe, "delta_v_m_s"));
    let summary = AbortSummary::new(safe);
    assert_eq!((summary.steps, summary.softened_steps, summary.uncertified_steps), (143, 0, 0));
    assert_eq!(summary.drifts.len(), 2);
    for drift in summary.drifts {
        assert_eq!((drift.states, drift.states_drifting_in), (144, 0), "{drift:?}");
        assert!(drift.least_gauge > 0.999, "{drift:?}");
    }
    // The service's own sets agree with where drifts lead.
    assert_eq!(safe.flights[0].unsafe_at(0), Some(None));
}
