//! Runs physics step and DRR of a scene in one process, driven by the scene's own controllers: no other
//! process, no log.

use std::time::Instant;

use controllers::{Controller, built_in};
use drr_proc::ThisMachine;
use hub::in_process::{Answer, InProcess};
use ipc_types::messages::services::MAX_KEYFRAME_BYTES;
use ipc_types::messages::{Latched, Restores, State};
use ipc_types::scene::{Drr, Holder, Mode, Notch, Scene, ToolRadii};
use simulation::{CtView, Simulation};
use voxel_grid::Volume;
use xray::frame::{Cache, Job, RenderedFrame, render_job};
use xray::from_scene::{renderer_parameters, scene_c_arm};
use xray::{CArm, DrrRenderer, VolumeView};

use serde_json::json;

use super::samples::Samples;
use super::{cut, failed};
use crate::sheet::Sheet;
use trabecula::failure::Failure;
use trabecula::launcher::volume_source;
use trabecula::machine::Machine;
use trabecula::scenes::SceneSource;

/// Number of final frames from a moved C-arm.
const FULL_FRAMES: usize = 9;

/// Runs the scene to its end, or for `ticks`, in lockstep in this process, then repeats the steps `rounds`
/// times and keeps each tick's minimum time. The ticks are bit-identical, so any difference comes from other
/// load on the machine.
///
/// # Errors
/// An invalid scene, or one whose controllers are not built in (2).
pub fn run(scene: &SceneSource, ticks: Option<u64>, rounds: usize, sheet: &mut Sheet) -> Result<(), Failure> {
    let mut scene = scene.load()?;
    scene.run.mode = Mode::Lockstep;
    cut(&mut scene, ticks);
    let ct =
        volume_source::load(&scene, volume_source::VolumeFiles::default()).map_err(Failure::bad_input)?;
    let volume = ct.as_ref().map(|ct| &ct.volume);
    let prepare = || -> Result<Bench, Failure> {
        let simulation = Simulation::new(&scene, volume.map(CtView::from)).map_err(failed)?;
        let x_ray = match (&scene.drr, volume) {
            (Some(drr), Some(volume)) => Some(XRay::new(&scene, drr, volume, simulation.predrilled())?),
            _ => None,
        };
        Ok(Bench {
            run: InProcess::new(&scene, simulation),
            x_ray,
            steps: Samples::default(),
            keyframes: Samples::default(),
            keyframe: vec![0; MAX_KEYFRAME_BYTES],
            keyframe_bytes: 0,
        })
    };
    let machine = Machine::watch();
    let mut bench = prepare()?;
    bench.play(&scene)?;
    let mut least = bench.steps.clone();
    for _ in 1..rounds {
        let mut again = prepare()?;
        again.play(&scene)?;
        least.keep_least(&again.steps);
    }
    let ticks = scene.tick_count();
    sheet.line(&format!("scene {}, {ticks} ticks of {} ms in one process\n", scene.name, scene.run.dt_ms));
    sheet.set("scene", json!(scene.name));
    sheet.set("ticks", json!(ticks));
    sheet.samples("physics step", "step", &bench.steps);
    if rounds > 1 {
        let name = format!("physics step, each tick's minimum of {rounds} rounds");
        sheet.samples(&name, "step_least", &least);
    }
    sheet.set("keyframe_bytes", json!(bench.keyframe_bytes));
    let name = format!("keyframe, {} bytes at the end", bench.keyframe_bytes);
    sheet.samples(&name, "keyframe", &bench.keyframes);
    if let Some(mut x_ray) = bench.x_ray.take() {
        x_ray.render_from_elsewhere(bench.run.plant().state())?;
        let what =
            format!("{} x {} pixels, {} threads", x_ray.c_arm.columns, x_ray.c_arm.rows, x_ray.threads);
        sheet.samples(&format!("DRR, full ({what})"), "drr_full", &x_ray.full);
        sheet.samples("DRR, C-arm at rest: incremental", "drr_changed", &x_ray.changed);
    }
    sheet.machine(&machine);
    Ok(())
}

struct Bench<'v> {
    run: InProcess<Simulation<'v>>,
    x_ray: Option<XRay<'v>>,
    steps: Samples,
    keyframes: Samples,
    keyframe: Vec<u8>,
    keyframe_bytes: usize,
}

impl Bench<'_> {
    fn play(&mut self, scene: &Scene) -> Result<(), Failure> {
        let mut controllers = controllers(scene)?;
        for tick in 0..scene.tick_count() {
            if let Some(x_ray) = &mut self.x_ray {
                let plant = self.run.plant();
                x_ray.exchange_frames(plant.state(), plant.removed(), scene, &mut controllers)?;
            }
            let latched = self.run.latch(|index, state, command| {
                controllers[index.slot()].step(state, command);
                Answer::Command
            });
            let latched = latched.map_err(failed)?;
            let began = Instant::now();
            one_step(&mut self.run, &latched)?;
            self.steps.add(began.elapsed().as_nanos() as u64);
            if scene.keyframe_period_ticks().is_some_and(|period| (tick + 1).is_multiple_of(period)) {
                let began = Instant::now();
                self.keyframe_bytes = self.run.plant().write_keyframe(&mut self.keyframe).map_err(failed)?;
                self.keyframes.add(began.elapsed().as_nanos() as u64);
            }
        }
        Ok(())
    }
}

/// The timed code, which a profiler counts ([`super::instructions`]).
#[inline(never)]
fn one_step(run: &mut InProcess<Simulation>, latched: &Latched) -> Result<(), Failure> {
    run.step(latched).map_err(failed)
}

fn controllers(scene: &Scene) -> Result<Vec<Box<dyn Controller>>, Failure> {
    let built_in = |entry: &ipc_types::scene::Controller| {
        built_in(scene, &entry.name, &ipc_types::text_file::read)
            .map_err(Failure::bad_input)?
            .ok_or_else(|| Failure::bad_input(format!("controller `{}` is not built in", entry.name)))
    };
    scene.controller.iter().map(built_in).collect()
}

/// The scene's X-ray, rendered frame by frame as in its process.
struct XRay<'v> {
    view: VolumeView<'v>,
    renderer: DrrRenderer,
    c_arm: CArm,
    threads: usize,
    noise_seed: u64,
    radii: ToolRadii,
    holder: Holder,
    notch: Option<Notch>,
    removed: Vec<u32>,
    shown: u64,
    newest: Option<RenderedFrame>,
    full: Samples,
    changed: Samples,
}

impl<'v> XRay<'v> {
    fn new(scene: &Scene, drr: &Drr, volume: &'v Volume, predrilled: &[u32]) -> Result<XRay<'v>, Failure> {
        let view = VolumeView::try_from(volume).map_err(failed)?;
        Ok(XRay {
            renderer: DrrRenderer::new(
                &view,
                renderer_parameters(drr, scene.tolerance.as_ref()),
                &ThisMachine,
            )
            .map_err(failed)?,
            view,
            c_arm: scene_c_arm(drr).map_err(Failure::bad_input)?,
            threads: drr.threads,
            noise_seed: scene.run.seed,
            radii: scene.manipulator.radii(),
            holder: scene.arm.holder(),
            notch: drr.notch,
            removed: predrilled.to_vec(),
            shown: 0,
            newest: None,
            full: Samples::default(),
            changed: Samples::default(),
        })
    }

    /// Passes the newest frame to the controllers when it is due, and renders the frames due at this state.
    fn exchange_frames(
        &mut self,
        state: &State,
        removed: &[u32],
        scene: &Scene,
        controllers: &mut [Box<dyn Controller>],
    ) -> Result<(), Failure> {
        self.removed.extend_from_slice(removed);
        if let Some(rendered) = &self.newest
            && scene.frame_seen_at(state.tick) == Some(rendered.frame.tick)
        {
            controllers.iter_mut().for_each(|controller| controller.frame(&rendered.frame, &rendered.pixels));
        }
        if scene.frame_period_ticks().is_some_and(|period| state.tick.is_multiple_of(period)) {
            self.newest = Some(self.render(state, self.c_arm)?);
        }
        Ok(())
    }

    fn render(&mut self, state: &State, c_arm: CArm) -> Result<RenderedFrame, Failure> {
        self.shown += 1;
        let job = Job {
            state: Box::new(*state),
            restores: Restores::Nothing,
            removed: std::mem::take(&mut self.removed),
            sequence: self.shown,
            request_id: 0,
            c_arm,
            cache: Cache::Follows,
            isocentre_m: [0.0; 3],
            notch: self.notch,
            noise_seed: self.noise_seed,
            radii: self.radii,
            holder: self.holder,
            around: Default::default(),
        };
        let began = Instant::now();
        let rendered = render_job(&mut self.renderer, &self.view, &job).map_err(failed)?;
        let render_ns = began.elapsed().as_nanos() as u64;
        let samples = if rendered.is_full() { &mut self.full } else { &mut self.changed };
        samples.add(render_ns);
        Ok(rendered)
    }

    /// Renders frames in which every ray is traced, by moving the C-arm by 1 mm between them.
    fn render_from_elsewhere(&mut self, state: &State) -> Result<(), Failure> {
        for frame in 1..=FULL_FRAMES {
            let shift_m = frame as f64 * 1e-3;
            let mut c_arm = self.c_arm;
            c_arm.source_m[2] += shift_m;
            c_arm.detector_centre_m[2] += shift_m;
            self.render(state, c_arm)?;
        }
        Ok(())
    }
}
