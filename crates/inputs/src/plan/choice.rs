//! Chooses the settings of a scene.

use ipc_types::scene::{ContactVoxels, Controller, Drives, Integrator, Scene, TubeDeployment};
use simulation::manipulator::Rung;
use simulation::rung;

use super::load::{Load, Pull, is_standard_tool, tendons_leave_the_plane};
use super::own::{self, Table};
use super::table::{Row, Settings, contact_name, integrator_name};
use crate::failure::Failure;

/// Settings that the scene's author fixed and the choice must keep.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct FixedSettings {
    /// `manipulator.model`.
    pub rung: Option<Rung>,
    /// `manipulator.links`.
    pub links: Option<usize>,
    /// `manipulator.integrator`.
    pub integrator: Option<Integrator>,
    /// `run.dt_ms`.
    pub dt_ms: Option<f64>,
    /// `contact.voxels`.
    pub contact: Option<ContactVoxels>,
}

impl FixedSettings {
    /// Reads the settings that a scene fixes; the scene file's `text` is needed to distinguish an explicit
    /// time step from the default.
    pub fn of(scene: &Scene, text: &str) -> FixedSettings {
        let table: toml::Table = toml::from_str(text).unwrap_or_default();
        let names_dt = table.get("run").is_some_and(|run| run.get("dt_ms").is_some());
        let manipulator = &scene.manipulator;
        FixedSettings {
            rung: manipulator.model.map(rung),
            links: manipulator.links,
            integrator: manipulator.integrator,
            dt_ms: names_dt.then_some(scene.run.dt_ms),
            contact: scene.contact.voxels,
        }
    }

    /// Balls are allowed only if the scene sets them: their drilled path is off by up to 12 mm, which a limit
    /// on the position at rest does not reveal.
    fn allows(&self, settings: &Settings) -> bool {
        self.rung.is_none_or(|rung| rung == settings.rung)
            && self.links.is_none_or(|links| links == settings.links)
            && self.integrator.is_none_or(|integrator| integrator == settings.integrator)
            && self.dt_ms.is_none_or(|dt_ms| dt_ms == settings.dt_ms)
            && self.contact.unwrap_or_default() == settings.contact
    }

    fn text(&self) -> String {
        let named = [
            self.rung.map(|rung| format!("model {}", rung.name())),
            self.links.map(|links| format!("{links} links")),
            self.integrator.map(|integrator| integrator_name(integrator).to_owned()),
            self.dt_ms.map(|dt_ms| format!("dt {dt_ms} ms")),
            self.contact.map(|contact| format!("contact {}", contact_name(contact))),
        ];
        let named: Vec<String> = named.into_iter().flatten().collect();
        if named.is_empty() { "nothing".to_owned() } else { named.join(", ") }
    }
}

/// The chosen settings.
#[derive(Debug, Clone, PartialEq)]
pub struct Choice {
    /// The row of the table.
    pub row: Row,
    /// Loads of the scene on the tool.
    pub load: Load,
    /// What the scene fixed.
    pub given: FixedSettings,
    /// The tool that the row was measured for; `None` for the standard one.
    pub tool: Option<String>,
}

impl Choice {
    /// The choice as text, one value per line.
    pub fn text(&self) -> String {
        let (row, load) = (&self.row, self.load);
        let hard = |error: f64| match load.pull {
            Pull::Gentle => String::new(),
            Pull::Hard => format!(", hard pull {error:.4}"),
        };
        let (mut tip, mut path) = (hard(row.hard_rest_mm), hard(row.hard_path_mm));
        if load.bone {
            tip += &format!(", voxels {:.4}", row.voxel_wall_mm);
            path += &format!(
                "; drilled {:.4} and place of the voxels {:.4}",
                row.drilled_path_mm, row.grid_path_mm
            );
        }
        let [beam, wall] = row.beam.map_or_else(Default::default, |beam| {
            let at_rest = [beam.end_moment_mm, beam.tip_force_mm, beam.capstan_mm, beam.wall_mm];
            let [moment, force, capstan, wall] = at_rest;
            [
                format!(
                    "end moment {moment:.4}, tip force {force:.4}, capstan {capstan:.4}, wall {wall:.4}, "
                ),
                format!("wall {:.4}, ", beam.wall_path_mm),
            ]
        });
        let (pull, costed) = match &self.tool {
            None => ("pull", "as measured for the table".to_owned()),
            Some(_) => ("loads in free space", "estimated from the standard tool's".to_owned()),
        };
        let mut lines = vec![
            format!("settings      {}", row.settings.text()),
            format!("named         {} (kept)", self.given.text()),
            format!(
                "tip error     {:.4} mm expected ({beam}{pull} {:.4}{tip})",
                row.tip_mm(load),
                row.rest_mm
            ),
            format!(
                "path error    {:.4} mm r.m.s. expected ({wall}{pull} {:.4}{path})",
                row.path_mm(load),
                row.free_path_mm
            ),
            format!("cost          {:.1} us per simulated millisecond, {costed}", row.us_per_ms(load)),
        ];
        if let Some(tool) = &self.tool {
            lines.push(format!("measured      for the scene's own tool, `{tool}`"));
        }
        lines.join("\n")
    }
}

/// Writes the cheapest settings within the scene's tolerance into the scene; `None` if the scene sets no tip
/// or path tolerance. The errors of a non-standard tool are measured, unless cached from an earlier use.
///
/// # Errors
/// Bad input: no measured settings meet the tolerance, or none of those that also match what the scene fixes;
/// or the scene's tool cannot be measured.
pub fn resolve(scene: &mut Scene, text: &str) -> Result<Option<Choice>, Failure> {
    if !asks(scene) {
        return Ok(None);
    }
    if !is_standard_tool(scene) {
        // Measuring takes long, so a scene that would be refused anyway is refused first.
        let given = FixedSettings::of(scene, text);
        if !own::settings(scene)?.iter().any(|settings| given.allows(settings)) {
            return Err(refusal(scene, &given, &[], Load::of(scene)));
        }
    }
    resolve_by(scene, text, &Table::of(scene)?)
}

/// As [`resolve`], with the errors of a given table.
///
/// # Errors
/// Bad input: no measured settings meet the tolerance, or none of those that also match what the scene fixes.
pub fn resolve_by(scene: &mut Scene, text: &str, table: &Table) -> Result<Option<Choice>, Failure> {
    let choice = choose(scene, FixedSettings::of(scene, text), table)?;
    if let Some(choice) = &choice {
        choice.row.settings.write_into(scene);
    }
    Ok(choice)
}

/// Whether a scene sets a tip or path tolerance.
fn asks(scene: &Scene) -> bool {
    scene.tolerance.is_some_and(|tolerance| tolerance.tip_mm.is_some() || tolerance.path_mm.is_some())
}

fn choose(scene: &Scene, given: FixedSettings, table: &Table) -> Result<Option<Choice>, Failure> {
    let Some(tolerance) = scene.tolerance.filter(|_| asks(scene)) else { return Ok(None) };
    let load = Load::of(scene);
    let flat = !leaves_the_plane(scene);
    let rows: Vec<&Row> = table
        .rows
        .iter()
        .filter(|row| given.allows(&row.settings))
        .filter(|row| flat || matches!(row.settings.rung, Rung::Spatial | Rung::Full))
        .collect();
    let within = |error: f64, allowed: Option<f64>| allowed.is_none_or(|allowed| error <= allowed);
    let best = rows
        .iter()
        .filter(|row| {
            within(row.tip_mm(load), tolerance.tip_mm) && within(row.path_mm(load), tolerance.path_mm)
        })
        .min_by(|a, b| a.us_per_ms(load).total_cmp(&b.us_per_ms(load)));
    match best {
        Some(row) => Ok(Some(Choice { row: **row, load, given, tool: table.tool.clone() })),
        None => Err(refusal(scene, &given, &rows, load)),
    }
}

/// Whether gravity, a tendon outside the bending plane, or bodies (which push from any direction) load the
/// tool out of plane: the planar models were not measured under those loads.
fn leaves_the_plane(scene: &Scene) -> bool {
    let (along, toward) = (scene.tool.direction, scene.tool.bend_toward);
    let across = cross(&along, &toward);
    let size = |v: &[f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    let gravity = &scene.gravity_m_per_s2;
    let part: f64 = across.iter().zip(gravity).map(|(a, g)| a * g).sum();
    let pulled = tendons_leave_the_plane(&scene.tendon, scene.manipulator.tool.as_ref());
    // A tool that rolls in its outer tube rotates its bending plane.
    let falls_aside = size(&cross(&along, gravity)) > 1e-6 * size(&along) * size(gravity).max(1e-300);
    let aside = falls_aside && scene.controller.iter().any(turns_its_plane);
    pulled || aside || !scene.body.is_empty() || part.abs() > 1e-6 * size(&across) * size(gravity).max(1e-300)
}

/// Whether a controller may roll a tool in its outer tube by anything but half turns.
fn turns_its_plane(entry: &Controller) -> bool {
    let stays = |plan: &TubeDeployment| plan.roll_deg % 180.0 == 0.0;
    entry.drives.contains(&Drives::Tube) && !entry.tube_deployment.as_ref().is_some_and(stays)
}

fn cross(a: &[f64; 3], b: &[f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn refusal(scene: &Scene, given: &FixedSettings, rows: &[&Row], load: Load) -> Failure {
    let named = given.text();
    if rows.is_empty() {
        return Failure::bad_input(format!(
            "`tolerance`: the scene fixes {named}, for which no errors were measured; use settings listed by \
             `trabecula plan --list SCENE`, or fix fewer of them"
        ));
    }
    let least = |error: &dyn Fn(&Row) -> f64| rows.iter().fold(f64::INFINITY, |low, row| low.min(error(row)));
    let tip_mm = least(&|row| row.tip_mm(load));
    let path_mm = least(&|row| row.path_mm(load));
    let tolerance = scene.tolerance.unwrap_or_default();
    let ask = |key: &str, asked: Option<f64>, least: f64| {
        asked.map(|asked| match least.is_finite() {
            true => format!("`tolerance.{key}` is {asked}; allowed: {least:.4} to 100"),
            false => format!("`tolerance.{key}` is {asked}, but all of them lose the tool; remove the key"),
        })
    };
    let asked: Vec<String> =
        [ask("tip_mm", tolerance.tip_mm, tip_mm), ask("path_mm", tolerance.path_mm, path_mm)]
            .into_iter()
            .flatten()
            .collect();
    Failure::bad_input(format!(
        "no measured settings meet this tolerance ({}; the scene fixes {named})",
        asked.join("; "),
    ))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use ipc_types::scene::ManipulatorRung;
    use std::path::Path;

    use super::*;
    use crate::plan::Beam;

    const SCENE: &str = r#"
name = "planned"
[run]
mode = "lockstep"
duration_s = 1.0
[tool]
burr_start_mm = [0.0, 0.0, 0.0]
direction = [0.0, 0.0, 1.0]
bend_toward = [1.0, 0.0, 0.0]
"#;

    const FREE: Load = Load { bone: false, pull: Pull::Gentle };

    fn scene(more: &str) -> (Scene, String) {
        let text = format!("{more}\n{SCENE}");
        (Scene::parse(&text, Path::new("planned.toml")).unwrap(), text)
    }

    /// Errors and costs in the expected order: fewer links, larger steps and simpler models are cheaper and
    /// less accurate.
    fn rows() -> Vec<Row> {
        let mut rows = Vec::new();
        // The modal model is never measured.
        let measured = Rung::ALL.into_iter().filter(|rung| *rung != Rung::Modal);
        for (rung, place) in measured.zip(1..) {
            for links in [4, 8, 27] {
                for integrator in [Integrator::LinearlyImplicitEuler, Integrator::Hybrid] {
                    let contacts = [ContactVoxels::Planes, ContactVoxels::Balls];
                    for (dt_ms, contact) in
                        [0.5, 1.0, 2.0].into_iter().flat_map(|dt| contacts.map(|kind| (dt, kind)))
                    {
                        let balls = contact == ContactVoxels::Balls;
                        let tip = if place == 1 { 5.0 } else { 10.0 / (links * links) as f64 };
                        let order = if integrator == Integrator::Hybrid { 0.1 } else { 1.0 };
                        let us = f64::from(place) * links as f64 / dt_ms * (2.0 - order);
                        rows.push(Row {
                            settings: Settings { rung, links, integrator, dt_ms, contact },
                            beam: Some(Beam {
                                end_moment_mm: 0.5 * tip,
                                tip_force_mm: tip,
                                capstan_mm: 0.1 * tip,
                                wall_mm: 0.2 * tip,
                                wall_path_mm: tip + 0.5 * order * dt_ms,
                            }),
                            voxel_wall_mm: if balls { 0.2 } else { 0.0 },
                            rest_mm: 0.3 * tip,
                            hard_rest_mm: 0.6 * tip,
                            free_path_mm: tip + order * dt_ms,
                            hard_path_mm: 2.0 * (tip + order * dt_ms),
                            grid_path_mm: 0.05,
                            drilled_path_mm: if links == 27 { tip + dt_ms } else { f64::NAN },
                            free_us_per_ms: us,
                            drilling_us_per_ms: match (links, balls) {
                                (27, true) => us + 10.0,
                                (27, false) => us + 20.0,
                                _ => f64::NAN,
                            },
                        });
                    }
                }
            }
        }
        rows
    }

    fn table() -> Table {
        Table { rows: rows(), tool: None }
    }

    fn planned(more: &str) -> Result<(Scene, Option<Choice>), Failure> {
        let (mut scene, text) = scene(more);
        resolve_by(&mut scene, &text, &table()).map(|choice| (scene, choice))
    }

    #[test]
    fn a_scene_without_tolerance_stays_as_it_is() {
        let (after, choice) = planned("").unwrap();
        assert_eq!((after, choice), (scene("").0, None));
        assert_eq!(planned("tolerance = {}").unwrap().1, None);
    }

    #[test]
    fn the_choice_is_in_the_resolved_scene_and_stays_when_resolved_again() {
        let (mut after, choice) = planned("tolerance = { tip_mm = 0.1, path_mm = 0.5 }").unwrap();
        let choice = choice.unwrap();
        assert!(choice.row.tip_mm(FREE) <= 0.1 && choice.row.path_mm(FREE) <= 0.5, "{choice:?}");
        assert_eq!(after.run.dt_ms, choice.row.settings.dt_ms);
        let resolved = after.clone();
        let text = toml::to_string(&after).unwrap();
        let again = resolve_by(&mut after, &text, &table()).unwrap().unwrap();
        assert_eq!((after, again.row.settings), (resolved, choice.row.settings));
    }

    /// With bone, only paths measured in bone count.
    #[test]
    fn a_scene_with_bone_gets_what_was_measured_in_bone() {
        let block = "volume = { phantom = \"block\" }\n";
        let free = planned("tolerance = { path_mm = 2.0 }").unwrap().1.unwrap();
        let bone = planned(&format!("{block}tolerance = {{ path_mm = 2.0 }}")).unwrap().1.unwrap();
        assert!(free.row.settings.links < 27 && bone.row.settings.links == 27, "{free:?} {bone:?}");
        assert!(bone.text().contains("drilled") && !free.text().contains("drilled"));
    }

    /// Regression: balls are cheaper in this table and accurate enough for a tip tolerance; without `path_mm`
    /// they were chosen.
    #[test]
    fn a_tolerance_never_chooses_balls() {
        let bone = |more: &str| planned(&format!("volume = {{ phantom = \"block\" }}\n{more}"));
        for tolerance in ["tip_mm = 0.5", "tip_mm = 0.1", "tip_mm = 100.0", "path_mm = 2.0"] {
            let (after, choice) = bone(&format!("tolerance = {{ {tolerance} }}")).unwrap();
            assert_eq!(choice.unwrap().row.settings.contact, ContactVoxels::Planes, "{tolerance}");
            assert_eq!(after.contact.voxels, Some(ContactVoxels::Planes));
        }
        for (named, contact) in [("planes", ContactVoxels::Planes), ("balls", ContactVoxels::Balls)] {
            let scene = format!("tolerance = {{ tip_mm = 0.5 }}\ncontact = {{ voxels = \"{named}\" }}");
            let choice = bone(&scene).unwrap().1.unwrap();
            assert_eq!(choice.row.settings.contact, contact);
            assert!(choice.text().contains(&format!("contact {named} (kept)")), "{}", choice.text());
        }
        let refused = bone("tolerance = { tip_mm = 0.1 }\ncontact = { voxels = \"balls\" }").unwrap_err();
        assert!(refused.code == 2 && refused.message.contains("contact balls"), "{refused}");
        let (free, _) = planned("tolerance = { tip_mm = 0.5 }").unwrap();
        assert_eq!(free.contact.voxels, None, "no bone, no contact with it");
    }

    #[test]
    fn what_the_scene_names_stays() {
        let (after, choice) = planned(
            "tolerance = { tip_mm = 1.0 }\nmanipulator = { model = \"spatial\", integrator = \"hybrid\" }",
        )
        .unwrap();
        assert_eq!(after.manipulator.model, Some(ManipulatorRung::Spatial));
        assert_eq!(choice.unwrap().row.settings.integrator, Integrator::Hybrid);
        let refused = planned("tolerance = { tip_mm = 1.0 }\nmanipulator = { links = 17 }").unwrap_err();
        assert!(refused.code == 2 && refused.message.contains("17 links"), "{refused}");
        let refused =
            planned("tolerance = { tip_mm = 100.0 }\nmanipulator = { model = \"modal\" }").unwrap_err();
        let said = "the scene fixes model modal, for which no errors were measured";
        assert!(refused.code == 2 && refused.message.contains(said), "{refused}");
    }

    /// Whether single flexures reach their stops, where the moment modes are invalid, is not known
    /// beforehand.
    #[test]
    fn no_table_offers_moment_modes() {
        let built_in = crate::plan::table::read(crate::plan::TABLE).unwrap();
        assert!(built_in.iter().all(|row| row.settings.rung != Rung::Modal));
    }

    #[test]
    fn loads_across_the_bending_plane_exclude_the_planar_rungs() {
        let choice = planned("gravity_m_per_s2 = [0.0, 9.81, 0.0]\ntolerance = { tip_mm = 10.0 }").unwrap().1;
        assert!(matches!(choice.unwrap().row.settings.rung, Rung::Spatial | Rung::Full));
        let choice = planned("gravity_m_per_s2 = [9.81, 0.0, 0.0]\ntolerance = { tip_mm = 10.0 }").unwrap().1;
        assert_eq!(choice.unwrap().row.settings.rung, Rung::ConstantCurvature);
    }

    #[test]
    fn what_nothing_keeps_is_refused_with_key_and_range() {
        let refused = planned("tolerance = { path_mm = 0.001 }").unwrap_err();
        assert!(
            refused.code == 2 && refused.message.contains("`tolerance.path_mm` is 0.001; allowed:"),
            "{refused}"
        );
        let text = format!("tolerance = {{ tip_mm = 0.0 }}\n{SCENE}");
        let refused = Scene::parse(&text, Path::new("planned.toml")).unwrap_err().to_string();
        assert!(refused.contains("`tolerance.tip_mm` is 0; allowed: 0.001 to 100"), "{refused}");
    }

    /// A looser tolerance never costs more, and the choice meets the tolerance.
    #[test]
    fn looser_is_never_dearer() {
        let (mut scene, _) = scene("tolerance = { tip_mm = 1.0, path_mm = 1.0 }");
        let table = table();
        let mut cost = |tip_mm: f64, path_mm: f64| {
            let tolerance = scene.tolerance.as_mut().unwrap();
            (tolerance.tip_mm, tolerance.path_mm) = (Some(tip_mm), Some(path_mm));
            let choice = choose(&scene, FixedSettings::default(), &table).ok()??;
            assert!(choice.row.tip_mm(FREE) <= tip_mm && choice.row.path_mm(FREE) <= path_mm);
            Some(choice.row.us_per_ms(FREE))
        };
        let steps: Vec<f64> = (0..24).map(|place| 0.005 * 1.4_f64.powi(place)).collect();
        let mut kept = 0;
        for pair in steps.windows(2) {
            for path in steps.windows(2) {
                if let Some(tight) = cost(pair[0], path[0]) {
                    kept += 1;
                    assert!(cost(pair[1], path[0]).unwrap() <= tight);
                    assert!(cost(pair[0], path[1]).unwrap() <= tight);
                }
            }
        }
        assert!(kept > 100, "{kept}");
    }
}
