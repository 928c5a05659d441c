//! Generates a scene file from a plan, as text for the user to edit.

use std::path::Path;

use markups::{Arc, Plan};

/// Bend of the standard tool in air per newton on its tendon, deg: `configs/calibration/tension_sweep.csv`.
/// Feedback compensates for the additional resistance of bone.
const BEND_DEG_PER_N: f64 = 8.65;
/// Feed on a curve, mm/s, as in the default scene.
const FEED_MM_PER_S: f64 = 1.5;
/// Feed on a straight line, mm/s. No tendon holds the tool on the line, and the burr's force, which
/// grows with the feed, bends it away. In the dense bone behind 55 mm of the pelvis phantom, the
/// final error is 0.89 mm at 1.5 mm/s and 0.62 mm at this feed (test `plans`).
const STRAIGHT_FEED_MM_PER_S: f64 = 0.5;
/// Simulated time after the feed for the tool to come to rest, s.
const REST_S: f64 = 2.0;
/// Slices thicker than this, mm, are resampled, because rough walls would jam the tool.
const THICK_MM: f64 = 1.0;
/// Voxel size after resampling, mm, as in `configs/pelvis_ct.toml`.
const RESAMPLED_MM: f64 = 0.75;

/// Inputs of a generated scene.
#[derive(Debug)]
pub struct PlannedScene<'a> {
    pub name: String,
    /// Path of the plan in the scene.
    pub plan_file: &'a Path,
    pub plan: Plan,
    /// Path of the volume in the scene.
    pub ct: &'a Path,
    /// The segment that is bone, if the volume is a segmentation.
    pub segment: Option<&'a str>,
    /// Largest voxel spacing of the three axes, mm.
    pub thickest_mm: f64,
    /// Distance of the tool's base from the flange, mm, if the default would put the arm into bone.
    pub from_flange_mm: Option<f64>,
}

impl PlannedScene<'_> {
    /// Returns the path from the burr's start to the target.
    pub fn arc(&self) -> Arc {
        self.plan.arc(0.0)
    }

    /// Returns the scene file's text.
    pub fn text(&self) -> String {
        let (plan, arc) = (&self.plan, self.arc());
        let (feed_mm_per_s, drilled, guidance) = match plan.is_curved() {
            true => (
                FEED_MM_PER_S,
                "A pilot hole from the entry to the bend, then a curve to the target.",
                format!(
                    "tension_n = {:.2}         # at the end of the ramp; the arc turns {:.1} deg\n\
                     feedback = \"shape\"       # corrects the tension from the measured shape; \"image\": \
                     from the burr in X-ray frames\n\
                     guidance_gain_n_per_mm = 0.2\n",
                    arc.turn_deg / BEND_DEG_PER_N,
                    arc.turn_deg,
                ),
            ),
            false => (
                STRAIGHT_FEED_MM_PER_S,
                "A pilot hole from the entry, then a straight line from its end to the target.",
                "feedback = \"none\"\n#> tension_n = 0.0\n".to_owned(),
            ),
        };
        let label = |name: &str| name.parse::<i32>().map_or_else(|_| quoted(name), |value| value.to_string());
        let mask = self.segment.map(|name| {
            format!(
                "mask = true              # a segmentation: filled with synthetic Hounsfield units\n\
                 label = {}          # the segment that is bone\n",
                label(name)
            )
        });
        let resample = (self.thickest_mm > THICK_MM).then(|| {
            format!(
                "resample_mm = {RESAMPLED_MM:?}       # its slices are {:.2} mm apart; thick voxels make a \
                 rough wall that jams the tool\n",
                self.thickest_mm
            )
        });
        let arm = self.from_flange_mm.map(|distance_mm| {
            format!(
                "[arm]\ntool_position_mm = [0.0, 0.0, {distance_mm:?}]  # from the flange: holder and bare \
                 shaft keep the wrist outside the bone\n\n"
            )
        });
        let [hole_from_mm, hole_to_mm] = plan.pilot_hole_mm().map(place);
        format!(
            include_str!("../templates/planned.toml"),
            name = quoted(&self.name),
            drilled = quoted(drilled),
            duration_s = (arc.length_mm / feed_mm_per_s + REST_S).ceil(),
            rest_s = REST_S,
            ct = quoted(&self.ct.display().to_string()),
            mask = mask.unwrap_or_default(),
            resample = resample.unwrap_or_default(),
            plan = quoted(&self.plan_file.display().to_string()),
            burr_start_mm = place(plan.burr_start_mm()),
            direction = direction(plan.direction()),
            bend_toward = direction(plan.bend_toward()),
            hole_from_mm = hole_from_mm,
            hole_to_mm = hole_to_mm,
            arm = arm.unwrap_or_default(),
            isocentre_mm = place(plan.middle_mm()),
            feed_mm_per_s = feed_mm_per_s,
            target_mm = place(plan.target_mm()),
            length_mm = arc.length_mm,
            guidance = guidance,
        )
    }
}

/// Quotes a string as TOML.
fn quoted(text: &str) -> String {
    toml::Value::String(text.to_owned()).to_string()
}

fn place([x, y, z]: [f64; 3]) -> String {
    format!("[{x:.3}, {y:.3}, {z:.3}]")
}

fn direction([x, y, z]: [f64; 3]) -> String {
    format!("[{x:.6}, {y:.6}, {z:.6}]")
}

#[cfg(test)]
mod tests {
    use super::*;
    use ipc_types::scene::Scene;

    const CURVE: &str = r#"{"markups": [{"type": "Curve", "coordinateSystem": "LPS", "controlPoints": [
        {"position": [0, 0, 0]}, {"position": [0, 0, 45.5]}, {"position": [5, 0, 65.25]}]}]}"#;
    const LINE: &str = r#"{"markups": [{"type": "Line", "coordinateSystem": "LPS", "controlPoints": [
        {"position": [0, 0, 0]}, {"position": [0, 0, 30]}]}]}"#;

    fn text_of(file: &str) -> String {
        let plan = Plan::of(&markups::read(file).unwrap()).unwrap();
        let planned = PlannedScene {
            name: "hip".to_owned(),
            plan_file: Path::new("plan.mrk.json"),
            plan,
            ct: Path::new("a \"b\".nrrd"),
            segment: Some("left hip"),
            thickest_mm: 3.0,
            from_flange_mm: None,
        };
        planned.text()
    }

    /// Every number of a scene, by its key.
    fn numbers(value: &toml::Value, path: &str, out: &mut Vec<(String, f64)>) {
        match value {
            toml::Value::Table(table) => {
                table.iter().for_each(|(key, value)| numbers(value, &format!("{path}.{key}"), out));
            }
            toml::Value::Array(values) => values.iter().for_each(|value| numbers(value, path, out)),
            toml::Value::Float(number) => out.push((path.to_owned(), *number)),
            toml::Value::Integer(number) => out.push((path.to_owned(), *number as f64)),
            _ => {}
        }
    }

    /// The commented-out lines must describe the same scene as the plan.
    #[test]
    fn the_lines_for_going_on_by_hand_are_the_same_scene_to_their_decimals() {
        for file in [CURVE, LINE] {
            let text = text_of(file);
            let read = |_: &Path| Ok(file.to_owned());
            let planned = Scene::parse_with(&text, Path::new("/s.toml"), &read).unwrap();
            let lines = text.lines().filter(|line| !line.starts_with("plan = "));
            let by_hand: Vec<&str> = lines.map(|line| line.strip_prefix("#> ").unwrap_or(line)).collect();
            let by_hand = Scene::parse(&by_hand.join("\n"), Path::new("/s.toml")).unwrap();
            let [planned, by_hand] = [planned, by_hand].map(|scene| {
                let mut all = Vec::new();
                numbers(&toml::Value::try_from(&scene).unwrap(), "", &mut all);
                all
            });
            assert_eq!(planned.len(), by_hand.len(), "{planned:?}\n{by_hand:?}");
            for ((key, planned), (_, by_hand)) in planned.iter().zip(&by_hand) {
                // Three decimals of mm.
                assert!((planned - by_hand).abs() <= 0.5e-3, "{key}: {planned} {by_hand}");
            }
        }
    }
}
