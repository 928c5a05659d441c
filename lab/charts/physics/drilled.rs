//! The drilled path of the default scene: its feed and tendon ramp, open loop, with any settings.

use std::time::Instant;

use controllers::built_in;
use hub::in_process::{Answer, InProcess};
use ipc_types::messages::Volume as VolumeMessage;
use ipc_types::scene::{Feedback, Mode, Scene};
use nalgebra::Vector3;
use simulation::{CtView, Simulation, ct_geometry};

use trabecula::failure::Failure;
use trabecula::launcher::volume_source;
use trabecula::plan::Settings;
use trabecula::scenes::BuiltIn;

/// The feed of 28 mm at 1.5 mm/s, before the tool retracts.
const DURATION_S: f64 = 18.6;
/// Sampling rate of the burr position.
const SAMPLES_PER_S: f64 = 100.0;

/// The burr at every sample, and the cost of a simulated millisecond (median step), µs.
pub type Drilled = (Vec<Vector3<f64>>, f64);

/// The default scene with its bone.
pub struct Drilling {
    scene: Scene,
    volume: VolumeMessage,
    hu: Vec<i16>,
}

impl Drilling {
    /// The scene with this voxel size, for a fraction of its length.
    ///
    /// # Errors
    /// The scene or its phantom cannot be built.
    pub fn new(spacing_mm: f64, share: f64) -> Result<Drilling, Failure> {
        let mut scene = BuiltIn::Femur.scene()?;
        scene.run.mode = Mode::Lockstep;
        scene.run.duration_s = share * DURATION_S;
        scene.drr = None;
        for controller in &mut scene.controller {
            if let Some(drilling) = &mut controller.curved_drilling {
                drilling.feedback = Feedback::None;
            }
        }
        if let Some(volume) = &mut scene.volume {
            volume.spacing_mm = spacing_mm;
        }
        let volume = volume_source::load(&scene, volume_source::VolumeFiles::default())
            .map_err(|cause| Failure::failed(cause.to_string()))?;
        let (volume, hash) = volume.ok_or_else(|| Failure::failed("the default scene has no volume"))?;
        Ok(Drilling { volume: volume_source::message(&volume, hash), hu: volume.hu, scene })
    }

    /// Drills with these settings.
    ///
    /// # Errors
    /// The physics refuses them.
    pub fn run(&self, settings: &Settings) -> Result<Drilled, Failure> {
        let failed = |cause: String| Failure::failed(format!("{}: {cause}", settings.text()));
        let mut scene = self.scene.clone();
        settings.write_into(&mut scene);
        let ct = CtView { geometry: ct_geometry(&self.volume), hu: &self.hu };
        let simulation = Simulation::new(&scene, Some(ct)).map_err(|cause| failed(cause.to_string()))?;
        let mut run = InProcess::new(&scene, simulation);
        let mut controllers = Vec::new();
        for entry in &scene.controller {
            let built_in = built_in(&scene, &entry.name, &ipc_types::text_file::read);
            controllers.extend(built_in.map_err(|cause| failed(cause.to_string()))?);
        }
        let every = (1.0 / (SAMPLES_PER_S * scene.dt_s()) + 0.5) as u64;
        let (mut path, mut nanoseconds) = (Vec::new(), Vec::new());
        for tick in 0..scene.tick_count() {
            let latched = run.latch(|index, state, command| {
                controllers[index].step(state, command);
                Answer::Command
            });
            let latched = latched.map_err(|cause| failed(cause.to_string()))?;
            let began = Instant::now();
            run.step(&latched).map_err(|cause| failed(cause.to_string()))?;
            nanoseconds.push(began.elapsed().as_nanos() as u64);
            if (tick + 1).is_multiple_of(every.max(1)) {
                path.push(Vector3::from(run.plant().state().t_world_burr.position_m));
            }
        }
        nanoseconds.sort_unstable();
        let median = nanoseconds.get(nanoseconds.len() / 2).copied().unwrap_or(0);
        Ok((path, median as f64 * 1e-3 / scene.run.dt_ms))
    }
}

/// Root mean square of the distance between two paths, mm; NaN if they cannot be compared.
pub fn distance_mm(path: &[Vector3<f64>], reference: &[Vector3<f64>]) -> f64 {
    if path.len() != reference.len() || path.is_empty() {
        return f64::NAN;
    }
    let squares: f64 = path.iter().zip(reference).map(|(a, b)| (a - b).norm_squared()).sum();
    (squares / path.len() as f64).sqrt() * 1e3
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_distance_of_paths_is_the_root_mean_square() {
        let path = [Vector3::zeros(), Vector3::x() * 4e-3];
        let other = [Vector3::y() * 3e-3, Vector3::x() * 4e-3 + Vector3::z() * 3e-3];
        assert!((distance_mm(&path, &other) - 3.0).abs() < 1e-12);
        assert!(distance_mm(&path, &other[..1]).is_nan() && distance_mm(&[], &[]).is_nan());
    }
}
