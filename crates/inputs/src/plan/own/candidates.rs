//! Candidate settings measured for a scene's own tool, and their costs.

use ipc_types::scene::{ContactVoxels, Integrator};
use simulation::Simulation;
use simulation::manipulator::Rung;

use super::tool::OwnTool;
use crate::failure::Failure;
use crate::plan::measure::trials::Trial;
use crate::plan::table::{OWN_LINKS, Row, Settings};

/// Measured models: all except `modal`, which is invalid while single flexures are at their stops, and a
/// scene does not reveal that beforehand. Numbers of equal links, for each model, besides the tool's own
/// flexures. The positions of the flexures matter more than the model, so the detailed models have few of
/// them.
const LINKS: [(Rung, &[usize]); 4] =
    [(Rung::ConstantCurvature, &[]), (Rung::Planar, &[4, 8, 16]), (Rung::Spatial, &[8]), (Rung::Full, &[])];
/// Time steps in free space, ms.
const DT_MS: [f64; 4] = [0.5, 1.0, 2.0, 5.0];
/// Largest sound time step in bone, and for a pre-curved tool with `hybrid`, ms.
const LARGEST_SOUND_STEP_MS: f64 = 2.0;
/// Time step of the built-in table from which the costs of other steps follow, ms.
const COSTED_DT_MS: f64 = 1.0;

/// Candidate settings in free space: all that the physics accepts with this tool.
///
/// # Errors
/// A trial cannot be built.
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

/// The arc has only one integrator, and the detailed models are used for their accuracy.
fn integrators(rung: Rung) -> &'static [Integrator] {
    match rung {
        Rung::ConstantCurvature => &[Integrator::LinearlyImplicitEuler],
        Rung::Modal | Rung::Planar => &[Integrator::LinearlyImplicitEuler, Integrator::Hybrid],
        Rung::Spatial | Rung::Full => &[Integrator::Hybrid],
    }
}

/// Whether `scene check` gives no warning for the time step.
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

/// Whether the drilled path is measured with these settings. It is most accurate with the tool's own
/// flexures; in contact both integrators are linearly implicit Euler; smaller steps improve it no further
/// than the voxels allow; and `scene check` warns about larger ones.
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

/// Cost of settings in free space and while drilling, µs per simulated millisecond: interpolated between the
/// built-in table's rows of the same model and integrator, by number of links. Uses no clock, so that every
/// machine chooses the same.
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
    // The cost of contact and drilling does not depend on the integrator: uses the own row if it was drilled,
    // or any of the same model.
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
