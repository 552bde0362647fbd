//! A trajectory as a file: JSON or CSV.

use vbar_client::v1::{Frame, RelativeState, StateTrajectory};

use crate::{failure::Failure, json};

/// What a state is made of, RTN.
const COLUMNS: [&str; 6] = ["x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s"];

/// States one sample apart, and the step of the first.
#[derive(Debug, PartialEq)]
pub(super) struct Given {
    pub(super) states: StateTrajectory,
    pub(super) first_step: i32,
}

/// Reads a `StateTrajectory` as JSON, or CSV with a line of column names; other columns than those
/// of the state and `k` are for others.
pub(super) fn parse(text: &str) -> Result<Given, Failure> {
    if text.trim_start().starts_with('{') {
        return Ok(Given { states: json::parse(text)?, first_step: 0 });
    }
    let mut lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let (_, titles) = lines.next().ok_or_else(|| Failure::data("an empty trajectory"))?;
    let titles: Vec<&str> = titles.split(',').map(str::trim).collect();
    let column = |name: &str| titles.iter().position(|title| *title == name);
    let missing: Vec<&str> = COLUMNS.into_iter().filter(|name| column(name).is_none()).collect();
    if !missing.is_empty() {
        return Err(Failure::data(format!("line 1: no column {}", missing.join(", "))));
    }
    let mut states = Vec::new();
    let mut steps = Vec::new();
    for (index, line) in lines {
        let cells: Vec<&str> = line.split(',').map(str::trim).collect();
        let place = format!("line {}", index + 1);
        if cells.len() != titles.len() {
            let counts = (cells.len(), titles.len());
            return Err(Failure::data(format!("{place}: {} cells, not {}", counts.0, counts.1)));
        }
        let number = |name: &str| -> Result<f64, Failure> {
            let cell = column(name).map_or("", |column| cells[column]);
            let value = cell.parse::<f64>().ok().filter(|value| value.is_finite());
            value.ok_or_else(|| Failure::data(format!("{place}: {name} is no number: {cell:?}")))
        };
        let components = COLUMNS.into_iter().map(number).collect::<Result<Vec<_>, _>>()?;
        states.push(RelativeState {
            frame: Frame::Rtn.into(),
            position_m: components[..3].to_vec(),
            velocity_m_s: components[3..].to_vec(),
        });
        if let Some(column) = column("k") {
            let step = cells[column].parse::<i32>();
            let wrong = |_| Failure::data(format!("{place}: k is no step: {:?}", cells[column]));
            steps.push(step.map_err(wrong)?);
        }
    }
    if steps.windows(2).any(|pair| pair[1] != pair[0] + 1) {
        return Err(Failure::data("the steps k are not one after the other"));
    }
    let first_step = steps.first().copied().unwrap_or(0);
    Ok(Given { states: StateTrajectory { states }, first_step })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn csv_columns_are_found_by_name() {
        let text =
            "k,vz_m_s,x_m,y_m,z_m,phase,vx_m_s,vy_m_s\n7,6,1,2,3,0,4,5\n8,0,0,0,0,0,0,-1e-3\n";
        let given = parse(text).unwrap();
        assert_eq!(given.first_step, 7);
        assert_eq!(given.states.states.len(), 2);
        let first = &given.states.states[0];
        assert_eq!(first.position_m, [1.0, 2.0, 3.0]);
        assert_eq!(first.velocity_m_s, [4.0, 5.0, 6.0]);
        assert_eq!(first.frame(), Frame::Rtn);
        assert_eq!(given.states.states[1].velocity_m_s[1], -1e-3);
    }

    #[test]
    fn json_is_the_contracts_own() {
        let text = r#"{"states": [{"frame": "FRAME_RTN", "positionM": [1, 2, 3], "velocityMS": [0, 0, 0]}]}"#;
        assert_eq!(parse(text).unwrap().states.states[0].position_m, [1.0, 2.0, 3.0]);
    }

    #[test]
    fn nonsense_is_refused_with_its_line() {
        let head = "x_m,y_m,z_m,vx_m_s,vy_m_s,vz_m_s";
        for (text, part) in [
            (String::new(), "empty"),
            ("x_m,y_m\n1,2".into(), "z_m"),
            (format!("{head}\n1,2,3"), "line 2"),
            (format!("{head}\n1,2,3,4,5,six"), "vz_m_s"),
            (format!("{head}\n1,2,3,4,5,NaN"), "vz_m_s"),
            (format!("k,{head}\n0,1,2,3,4,5,6\n2,1,2,3,4,5,6"), "steps"),
            (format!("k,{head}\nx,1,2,3,4,5,6"), "k is no step"),
            ("{\"states\": 3}".into(), "StateTrajectory"),
        ] {
            let failure = parse(&text).unwrap_err();
            assert!(failure.to_string().contains(part), "{failure} lacks {part}");
            assert_eq!(failure.code, 65);
        }
    }
}
