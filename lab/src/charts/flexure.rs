//! `trabecula-lab chart flexure`: stiffness of a flexure by formula, compared with finite elements of the
//! notched tube.

use std::path::Path;

use serde_json::json;
use simulation::manipulator::{ManipulatorParameters, Notch, UnitStiffness};

use super::peers::{new_input, run as run_script, scripts};
use crate::sheet::Sheet;
use trabecula::failure::Failure;

/// Compared flexures of the standard tool: the first, a middle one and the last.
const FLEXURES: [usize; 3] = [0, 13, 26];
/// Maximum difference between formula and finite elements.
const ALLOWED: f64 = 0.10;
const NAMES: [&str; 6] = ["axial", "shear toward", "shear across", "bending", "lateral", "torsion"];

/// One output line of the script: the sample, and its six stiffnesses for 1 Pa.
#[derive(Debug, PartialEq)]
struct Sample {
    name: String,
    stiffness: [f64; 6],
}

/// Compares and prints.
///
/// # Errors
/// Bad input: a mesh size out of range, or no script. Failure: a script that cannot be run, or a formula that
/// is off by more than 10 %.
pub fn run(out: &Path, peers: &Path, size_mm: f64, sheet: &mut Sheet) -> Result<(), Failure> {
    if !(0.05..=0.5).contains(&size_mm) {
        return Err(Failure::bad_input(format!("--size-mm is {size_mm}; allowed: 0.05 to 0.5")));
    }
    let work = std::path::absolute(out.join("peers-flexure"));
    let work = work.map_err(|cause| Failure::failed(format!("{}: {cause}", out.display())))?;
    let tool = ManipulatorParameters::jhu_27();
    let z = &tool.joint_positions_m;
    let mut worst: f64 = 0.0;
    for flexure in FLEXURES {
        let (from, to) = (flexure.saturating_sub(1), (flexure + 1).min(z.len() - 1));
        let pitch_m = (z[to] - z[from]) / (to - from) as f64;
        let own = Notch::JHU.unit_stiffness(pitch_m, tool.tube_radii_m, tool.poisson_ratio);
        let input = new_input(&work)?;
        let geometry = json!({
            "outer_radius_mm": tool.tube_radii_m[0] * 1e3,
            "inner_radius_mm": tool.tube_radii_m[1] * 1e3,
            "notch_width_mm": Notch::JHU.width_m * 1e3,
            "notch_past_axis_mm": Notch::JHU.past_axis_m * 1e3,
            "pitch_mm": pitch_m * 1e3,
            "poisson_ratio": tool.poisson_ratio,
            "sizes_mm": [size_mm],
            "flexures": [1, 3],
        });
        output_file::write(&input.path().join("flexure.json"), geometry.to_string())?;
        for (name, script) in scripts(peers)? {
            let printed = run_script(&script, &name, &work, input.path())
                .map_err(|cause| Failure::failed(format!("{name}: {cause}")))?;
            let samples: Vec<Sample> = printed.lines().filter_map(sample).collect();
            let implied_gpa = tool.joint_stiffness_nm_per_rad[flexure] / own.bending_nm_per_rad * 1e-9;
            sheet.line(&format!("flexure {}, pitch {:.4} mm, {name}", flexure + 1, pitch_m * 1e3));
            worst = worst.max(tell(&own, &samples, sheet));
            sheet.line(&format!(
                "modulus at which the formula gives the table's bending stiffness: {implied_gpa:.1} GPa\n"
            ));
            let listed_samples: Vec<_> = samples
                .iter()
                .map(|sample| json!({"name": sample.name, "stiffness_for_1_pa": sample.stiffness}))
                .collect();
            let figures = json!({
                "flexure": flexure + 1, "pitch_m": pitch_m, "script": name, "formula_for_1_pa": listed(&own),
                "samples": listed_samples, "implied_modulus_gpa": implied_gpa,
            });
            sheet.push("flexures", figures);
        }
    }
    if worst > ALLOWED {
        return Err(Failure::failed(format!(
            "a formula is {:.0} % off the middle of three flexures; allowed: {:.0} %",
            100.0 * worst,
            100.0 * ALLOWED
        )));
    }
    Ok(())
}

fn listed(stiffness: &UnitStiffness) -> [f64; 6] {
    [
        stiffness.axial_n_per_m,
        stiffness.shear_toward_n_per_m,
        stiffness.shear_across_n_per_m,
        stiffness.bending_nm_per_rad,
        stiffness.lateral_nm_per_rad,
        stiffness.torsion_nm_per_rad,
    ]
}

/// Prints the table for 1 GPa; returns the largest difference from the middle one of three flexures.
fn tell(own: &UnitStiffness, samples: &[Sample], sheet: &Sheet) -> f64 {
    let head: String = samples.iter().map(|sample| format!("{:>24}", sample.name)).collect();
    sheet.line(&format!("{:<14}{:>12}{head}", "for 1 GPa", "formula"));
    let mut worst: f64 = 0.0;
    for (place, (name, own)) in NAMES.into_iter().zip(listed(own)).enumerate() {
        let mut line = format!("{name:<14}{:>12.4e}", own * 1e9);
        for sample in samples {
            let off = own / sample.stiffness[place] - 1.0;
            line += &format!("{:>15.4e} ({:+5.1} %)", sample.stiffness[place] * 1e9, 100.0 * off);
            if sample.name == "middle of 3" {
                worst = worst.max(off.abs());
            }
        }
        sheet.line(&line);
    }
    worst
}

/// Parses a line `stiffness FLEXURES SIZE UNKNOWNS` or `chain …` with six numbers; `None` for other lines.
fn sample(line: &str) -> Option<Sample> {
    let words: Vec<&str> = line.split_whitespace().collect();
    let [word, flexures, _, _, rest @ ..] = words.as_slice() else { return None };
    let numbers: Vec<f64> = rest.iter().map_while(|word| word.parse().ok()).collect();
    let name = match (*word, *flexures) {
        ("stiffness", "1") => "one alone".to_owned(),
        ("stiffness", count) => format!("middle of {count}"),
        ("chain", count) => format!("{count} less one"),
        _ => return None,
    };
    Some(Sample { name, stiffness: numbers.try_into().ok()? })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_of_the_script_is_a_sample_and_others_are_not() {
        let stiffness = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let expected = Sample { name: "middle of 3".to_owned(), stiffness };
        assert_eq!(sample("stiffness 3 0.15 600 1 2 3 4 5 6"), Some(expected));
        assert!(sample("chain 3 0.15 0 1 nan nan 4 5 6").is_some());
        assert_eq!(sample("Info : done"), None);
        assert_eq!(sample("stiffness 3 0.15 600 1 2 3"), None);
    }
}
