//! One line an instant, for a spreadsheet; axes and units in the names of the columns.

use std::fmt::Write as _;

use vbar_guidance::control::disturbance_feedback::Plan;

use super::calendar_after;

const COLUMNS: &str = "instant,elapsed_s,epoch,true_anomaly_deg,\
    position_x_lvlh_ccsds_m,position_y_lvlh_ccsds_m,position_z_lvlh_ccsds_m,\
    velocity_x_lvlh_ccsds_m_s,velocity_y_lvlh_ccsds_m_s,velocity_z_lvlh_ccsds_m_s,\
    outer_half_width_x_m,outer_half_width_y_m,outer_half_width_z_m,\
    delta_v_x_lvlh_ccsds_m_s,delta_v_y_lvlh_ccsds_m_s,delta_v_z_lvlh_ccsds_m_s,\
    correction_max_x_m_s,correction_max_y_m_s,correction_max_z_m_s,\
    saturation_margin_x_m_s,saturation_margin_y_m_s,saturation_margin_z_m_s";

/// Columns that are empty at the last instant, which has no burn.
const BURN_COLUMNS: usize = 9;

/// Writes the table (RFC 4180). The half widths are those of the box around the outer ellipsoid.
pub(super) fn write(plan: &Plan) -> String {
    let outcome = plan.outcome();
    let epoch = plan.problem().epoch.as_ref();
    let mut text = format!("{COLUMNS}\r\n");
    for (k, planned) in outcome.states.iter().enumerate() {
        let when = epoch.map(|epoch| calendar_after(epoch, planned.elapsed)).unwrap_or_default();
        let (elapsed, anomaly) = (planned.elapsed.seconds(), planned.true_anomaly.degrees());
        let mut line = format!("{k},{elapsed},{when},{anomaly}");
        let (position, velocity) =
            (planned.state.position_m.components, planned.state.velocity_m_s.components);
        let half_widths = (0..3).map(|i| planned.outer_shape[(i, i)].sqrt());
        for value in position.iter().chain(&velocity).copied().chain(half_widths) {
            append(&mut line, value);
        }
        match outcome.burns.get(k) {
            Some(burn) => {
                let parts = [burn.delta_v_m_s, burn.correction_max_m_s, burn.saturation_margin_m_s];
                parts.iter().flatten().for_each(|&value| append(&mut line, value));
            }
            None => line.extend(std::iter::repeat_n(',', BURN_COLUMNS)),
        }
        text.push_str(&line);
        text.push_str("\r\n");
    }
    text
}

/// The shortest digits that give the same number back.
fn append(line: &mut String, value: f64) {
    write!(line, ",{value}").expect("a String takes everything");
}
