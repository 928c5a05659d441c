//! The settings that are measured for a scene's own tool, and what they cost.

use ipc_types::scene::{ContactVoxels, Integrator};
use simulation::Simulation;
use simulation::manipulator::Rung;

use super::tool::OwnTool;
use crate::failure::Failure;
use crate::plan::measure::trials::Trial;
use crate::plan::table::{OWN_LINKS, Row, Settings};

/// Measured models: all but `modal`, which is not valid where single flexures stand on their stops, and no
/// scene says beforehand whether they will. Equal links in place of the tool's flexures, for each rung. Where
/// each flexure lies decides more than how the rest is computed, so the richer rungs have few of them.
const LINKS: [(Rung, &[usize]); 4] =
    [(Rung::ConstantCurvature, &[]), (Rung::Planar, &[4, 8, 16]), (Rung::Spatial, &[8]), (Rung::Full, &[])];
/// Steps in free space, ms.
const DT_MS: [f64; 4] = [0.5, 1.0, 2.0, 5.0];
/// Up to here steps are sound in bone, and of a pre-curved tool with `hybrid`, ms.
const LARGEST_SOUND_STEP_MS: f64 = 2.0;
/// The step of the built-in table that the costs of other steps follow from, ms.
const COSTED_DT_MS: f64 = 1.0;

/// The settings to measure in free space: all that the physics takes with this tool.
///
/// # Errors
/// A trial cannot be made.
pub fn settings(tool: &OwnTool) -> Result<Vec<Settings>, Failure> {
    let mut all = Vec::new();
    let flexures = tool.flexures()?;
    for (rung, links) in LINKS {
        for links in links.iter().copied().filter(|links| *links < flexures).chain([flexures]) {
            for &integrator in integrators(rung) {
                let at = |dt_ms| Settings { rung, links, integrator, dt_ms, contact: ContactVoxels::Planes };
                if is_taken(tool, &at(COSTED_DT_MS))? {
                    all.extend(DT_MS.map(at).into_iter().filter(|settings| is_sound(tool, settings)));
                }
            }
        }
    }
    Ok(all)
}

/// The arc has only one integrator, and the richer rungs are there for their accuracy.
fn integrators(rung: Rung) -> &'static [Integrator] {
    match rung {
        Rung::ConstantCurvature => &[Integrator::LinearlyImplicitEuler],
        Rung::Modal | Rung::Planar => &[Integrator::LinearlyImplicitEuler, Integrator::Hybrid],
        Rung::Spatial | Rung::Full => &[Integrator::Hybrid],
    }
}

/// Not a step of which `scene check` warns.
fn is_sound(tool: &OwnTool, settings: &Settings) -> bool {
    let is_hybrid = settings.integrator == Integrator::Hybrid;
    !(is_hybrid && tool.is_pre_curved()) || settings.dt_ms <= LARGEST_SOUND_STEP_MS
}

fn is_taken(tool: &OwnTool, settings: &Settings) -> Result<bool, Failure> {
    if tool.bends_across() && settings.rung < Rung::Spatial {
        return Ok(false);
    }
    let mut scene = tool.scene(&Trial::hold(0.0, 0.0), false)?;
    settings.write_into(&mut scene);
    Ok(Simulation::new(&scene, None).is_ok())
}

/// Whether the drilled path is measured with these settings. It is best with the tool's own flexures, in
/// contact both integrators are linearly implicit Euler, smaller steps make it no better than the bone's
/// voxels allow, and `scene check` warns of larger ones.
pub fn is_drilled(settings: &Settings, flexures: usize) -> bool {
    settings.links == flexures
        && match settings.rung {
            Rung::ConstantCurvature => settings.dt_ms == COSTED_DT_MS,
            Rung::Modal | Rung::Planar | Rung::Spatial | Rung::Full => {
                settings.integrator == Integrator::Hybrid
                    && (COSTED_DT_MS..=LARGEST_SOUND_STEP_MS).contains(&settings.dt_ms)
            }
        }
}

/// What settings cost in free space and while drilling, µs per simulated millisecond: what the built-in
/// table's row of the same rung and integrator does, on a line through its numbers of links. No clock, so
/// that every machine chooses alike.
pub fn cost(settings: &Settings, standard: &[Row]) -> [f64; 2] {
    let at_links =
        |row: &Row, links: usize| row.settings == Settings { links, dt_ms: COSTED_DT_MS, ..*settings };
    let own = standard.iter().find(|row| at_links(row, OWN_LINKS));
    let Some(own) = own else { return [f64::NAN; 2] };
    let few =
        standard.iter().filter(|row| row.settings.links < OWN_LINKS && at_links(row, row.settings.links));
    let few = few.min_by_key(|row| row.settings.links);
    let a_link = few.map_or(0.0, |few| {
        (own.free_us_per_ms - few.free_us_per_ms) / (own.settings.links - few.settings.links) as f64
    });
    let links = settings.links as f64 - own.settings.links as f64;
    let step_us = (own.free_us_per_ms + links * a_link).max(0.1 * own.free_us_per_ms);
    // What contact and drilling add does not depend on the integrator: its own row, if it was drilled, or any
    // of the rung.
    let of_rung =
        || standard.iter().filter(|row| row.settings.rung == settings.rung && at_contact(row, settings));
    let bone_us = of_rung()
        .filter(|row| row.settings.integrator == settings.integrator)
        .chain(of_rung())
        .map(|row| row.drilling_us_per_ms - row.free_us_per_ms)
        .find(|us| us.is_finite())
        .unwrap_or(f64::NAN);
    [step_us, step_us + bone_us].map(|us| us * COSTED_DT_MS / settings.dt_ms)
}

fn at_contact(row: &Row, settings: &Settings) -> bool {
    row.settings.links == OWN_LINKS
        && row.settings.dt_ms == COSTED_DT_MS
        && row.settings.contact == settings.contact
}
