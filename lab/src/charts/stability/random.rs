//! Random scenes over the documented or the validated ranges, from the scene's own schema.

use std::fmt::Write as _;
use std::path::Path;

use ipc_types::messages::MAX_TENDONS;
use ipc_types::scene::{self, Scene};
use serde_json::Value;
use simulation::validated_range;

use crate::random::uniform;
use crate::reproduce::rig::Block;
use trabecula::failure::Failure;

/// Drawn tables of parameters: keys and probability.
const TABLES: [(&str, &str, f64); 3] =
    [("Manipulator", "manipulator", 0.5), ("Contact", "contact", 0.4), ("Drilling", "drilling", 0.3)];
/// Ranges with at least this ratio of their ends are drawn uniformly in their logarithm.
const WIDE: f64 = 50.0;
/// Duration of the commands at the start of a scene, s, and of each command.
pub const DRIVEN_S: f64 = 0.3;
const COMMAND_S: f64 = 0.05;
/// Time for which the scene then rests under the last command, s.
pub const REST_S: f64 = 0.2;
const BONE: f64 = 0.5;
/// Validated steps, ms.
const STEPS_MS: [f64; 2] = [0.1, 5.0];

/// The ranges from which scenes are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ranges {
    /// Those that a scene accepts.
    Documented,
    /// Those within which the simulation is validated.
    Validated,
}

impl Ranges {
    /// Returns the ends of a key's range, given the documented ones.
    fn of(self, key: &str, documented: [f64; 2]) -> [f64; 2] {
        match self {
            Ranges::Documented => documented,
            Ranges::Validated if key == "run.dt_ms" => STEPS_MS,
            Ranges::Validated => validated_range(key).unwrap_or(documented),
        }
    }
}

/// A scene, and its commands.
pub struct Drawn {
    /// The scene.
    pub scene: Scene,
    /// Keys set by the scene.
    pub keys: String,
    /// Tension of each tendon in each interval of [`COMMAND_S`], N; the last one holds at rest.
    tensions_n: Vec<[f64; MAX_TENDONS]>,
    /// Feed of the arm while it is driven, m/s.
    pub feed_m_per_s: f64,
    /// Speed of the burr, rad/s.
    pub burr_speed_rad_per_s: f64,
    /// The bone, if any.
    pub bone: Option<Block>,
}

impl Drawn {
    /// Returns the scene of a seed.
    ///
    /// # Errors
    /// The schema lacks a table that is drawn, or the scene is refused.
    pub fn of(seed: u64, ranges: Ranges) -> Result<Drawn, Failure> {
        let schema = scene::json_schema();
        let random = &mut (seed ^ 0x5eed_0000_0000_0000);
        let mut keys = String::new();
        for (definition, table, probability) in TABLES {
            let properties = &schema["definitions"][definition]["properties"];
            let properties = properties.as_object().ok_or_else(|| missing(definition))?;
            let _ = writeln!(keys, "[{table}]");
            for (key, property) in properties {
                if uniform(random) < probability
                    && may_follow(key, &keys)
                    && let Some(value) =
                        value_of(&schema, property, (ranges, &format!("{table}.{key}")), random)
                {
                    let _ = writeln!(keys, "{key} = {value}");
                }
            }
        }
        let dt_ms = &schema["definitions"]["Run"]["properties"]["dt_ms"];
        let dt_ms = value_of(&schema, dt_ms, (ranges, "run.dt_ms"), random);
        let dt_ms = dt_ms.ok_or_else(|| missing("Run"))?;
        let tension = &schema["definitions"]["Hold"]["properties"]["tension_n"];
        let tensions_n = (0..(DRIVEN_S / COMMAND_S) as usize).map(|_| draw_tensions(tension, random));
        let tensions_n = tensions_n.collect();
        let bone = (uniform(random) < BONE).then(|| block(random));
        let volume = if bone.is_some() { VOLUME } else { "" };
        let text = format!(
            "name = \"random\"\n[run]\nmode = \"lockstep\"\nduration_s = {:?}\ndt_ms = \
             {dt_ms}\n{volume}{keys}{REST}",
            DRIVEN_S + REST_S
        );
        let mut scene = Scene::parse(&text, Path::new("random.toml"))
            .map_err(|cause| Failure::failed(format!("seed {seed}: {cause}")))?;
        // No protective stop: forces of any size are to be survived.
        scene.arm.max_force_n = Some(1e5);
        let keys = format!("dt_ms = {dt_ms}\n{volume}{keys}");
        let feed_m_per_s = [0.0, 1e-3, 2e-2][(3.0 * uniform(random)) as usize];
        let burr_speed_rad_per_s = [0.0, 235.6, 6283.0][(3.0 * uniform(random)) as usize];
        Ok(Drawn { scene, keys, tensions_n, feed_m_per_s, burr_speed_rad_per_s, bone })
    }

    /// Returns the tensions at a time, N.
    pub fn tensions_n(&self, seconds: f64) -> [f64; MAX_TENDONS] {
        let last = self.tensions_n.len() - 1;
        self.tensions_n[((seconds / COMMAND_S) as usize).min(last)]
    }

    /// Returns the maximum of all tensions, N.
    pub fn greatest_tension_n(&self) -> f64 {
        self.tensions_n.iter().flatten().copied().fold(0.0, f64::max)
    }

    /// Returns the keys set by the scene, on one line.
    pub fn line(&self) -> String {
        let keys = self.keys.lines().filter(|line| !line.starts_with('[') && line.contains('='));
        keys.collect::<Vec<_>>().join(", ")
    }
}

const VOLUME: &str = "[volume]\nphantom = \"block\"\nbone_threshold_hu = -100\n[[predrill]]\nfrom_mm = \
[0.0, 0.0, -60.0]\n\
                      to_mm = [0.0, 0.0, 0.0]\ndiameter_mm = 8.0\n";
const REST: &str = "[tool]\nburr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\nbend_toward = \
[1.0, 0.0, 0.0]\n\
                    [[controller]]\nname = \"driver\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\nexternal = \
                    true\n";

/// Whether a scene can set a key in addition to those already set.
fn may_follow(key: &str, keys: &str) -> bool {
    match key {
        // Two alternatives, of which a scene can use only one.
        "edge_pressure_mpa" => !keys.contains("edge_force_n_per_mm"),
        // The other law needs a bit, which is another tool.
        "law" => false,
        "modes" => keys.contains("model = \"modal\""),
        _ => true,
    }
}

fn missing(what: &str) -> Failure {
    Failure::failed(format!("the scene's schema has no `{what}`"))
}

/// Draws tensions of two antagonists; half of the commands leave the second one slack.
fn draw_tensions(range: &Value, random: &mut u64) -> [f64; MAX_TENDONS] {
    let mut tensions_n = [0.0; MAX_TENDONS];
    for tension in tensions_n.iter_mut().take(2) {
        let both = uniform(random) < 0.75;
        let drawn = ends(range).map_or(0.0, |[low, high]| draw(low, high, random));
        *tension = if both { drawn } else { 0.0 };
    }
    tensions_n
}

fn ends(property: &Value) -> Option<[f64; 2]> {
    Some([property["minimum"].as_f64()?, property["maximum"].as_f64()?])
}

/// Draws each end of the range with a probability of a quarter.
fn draw(low: f64, high: f64, random: &mut u64) -> f64 {
    match uniform(random) {
        u if u < 0.25 => low,
        u if u > 0.75 => high,
        _ if low > 0.0 && high / low > WIDE => low * (high / low).powf(uniform(random)),
        _ => low + (high - low) * uniform(random),
    }
}

/// Returns a key's value as TOML: a number within its range, or one of its words. `None` for a path, a text
/// or a table.
fn value_of(
    schema: &Value,
    property: &Value,
    (ranges, key): (Ranges, &str),
    random: &mut u64,
) -> Option<String> {
    if let Some(documented) = ends(property) {
        let [low, high] = ranges.of(key, documented);
        let value = draw(low, high, random);
        let whole = property["type"] == "integer";
        return Some(if whole { format!("{}", value as u64) } else { format!("{value:?}") });
    }
    if property["type"] == "boolean" {
        return Some(format!("{}", uniform(random) < 0.5));
    }
    let named = property["$ref"].as_str().or_else(|| property["allOf"][0]["$ref"].as_str())?;
    let words = &schema["definitions"][named.rsplit('/').next()?];
    let of_enum = words["enum"].as_array().map(|words| words.iter().collect::<Vec<_>>());
    let of_choice = || {
        let choices = words["oneOf"].as_array()?;
        Some(choices.iter().map(|choice| choice.get("const").unwrap_or(&choice["enum"][0])).collect())
    };
    let words: Vec<&Value> = of_enum.or_else(of_choice)?;
    let word = words.get((uniform(random) * words.len() as f64) as usize)?.as_str()?;
    Some(format!("{word:?}"))
}

/// Returns a small block around the tool's pilot hole, of one density, with voxels of 0.3 to 2 mm.
fn block(random: &mut u64) -> Block {
    let voxel_mm = draw(0.3, 2.0, random);
    let density = draw(100.0, 1900.0, random);
    Block::new([-12.0, -9.0, -30.0], [12.0, 9.0, 18.0], voxel_mm, |_| density)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    /// Another tool, by a file or a table; only changes of the standard tool are drawn.
    const DESCRIBED: [&str; 2] = ["file", "tool"];

    #[test]
    fn every_drawn_scene_can_be_read() {
        let drawn = |seed| Drawn::of(seed, Ranges::Documented).unwrap();
        let with_modes = (0..600).filter(|seed| drawn(*seed).keys.contains("modes")).count();
        assert!(with_modes > 10, "{with_modes}");
    }

    #[test]
    fn validated_scenes_stay_within_the_validated_ranges() {
        for seed in 0..200 {
            let scene = Drawn::of(seed, Ranges::Validated).unwrap().scene;
            let within = |[low, high]: [f64; 2], value: f64| (low..=high).contains(&value);
            assert!(within(STEPS_MS, scene.run.dt_ms), "{seed}: {} ms", scene.run.dt_ms);
            let tool = &scene.manipulator;
            for (key, value) in [("stiffness_scale", tool.stiffness_scale), ("mass_scale", tool.mass_scale)] {
                let range = validated_range(&format!("manipulator.{key}")).unwrap();
                assert!(value.is_none_or(|value| within(range, value)), "{seed}: {key} {value:?}");
            }
        }
    }

    /// A key of a kind unknown to the generator would be left out silently.
    #[test]
    fn every_key_of_the_drawn_tables_is_drawn_and_reaches_both_ends() {
        let schema = scene::json_schema();
        for (definition, _, _) in TABLES {
            let properties = schema["definitions"][definition]["properties"].as_object().unwrap();
            for (key, property) in properties.iter().filter(|(key, _)| !DESCRIBED.contains(&key.as_str())) {
                let random = &mut 1;
                let values: Vec<String> = (0..200)
                    .map(|_| value_of(&schema, property, (Ranges::Documented, key), random))
                    .map(|value| value.unwrap_or_else(|| panic!("{key}")))
                    .collect();
                if let Some([low, high]) = ends(property) {
                    let has = |end: f64| values.iter().any(|value| value.parse::<f64>() == Ok(end));
                    assert!(has(low) && has(high), "{definition}.{key}");
                } else {
                    assert!(values.iter().any(|value| *value != values[0]), "{definition}.{key}");
                }
            }
        }
    }
}
