//! A block of bone and a tool fed into it: the complete simulation in this process.

use std::path::Path;

use hub::in_process::{Answer, InProcess};
use ipc_types::messages::{ArmMode, BurrMode, Command, State, TendonMode, TubeMode};
use ipc_types::scene::Scene;
use nalgebra::Vector3;
use simulation::{CtView, Simulation};

use trabecula::failure::Failure;
pub use trabecula::plan::measure::block::Block;

/// Force on the flange that no rig reaches, N.
const UNLIMITED_N: f64 = 1e5;

/// Duration of the tension ramp before the feed begins, s.
const RAMP_S: f64 = 1.0;
/// Pause after the feed, s.
const REST_S: f64 = 0.5;
/// Bone threshold, HU: below the lightest foam.
const THRESHOLD_HU: i16 = -100;

/// The tool's motion and parameters. The tool points along +z, bends toward +x, and starts with its burr in
/// the blind end of a pilot hole.
#[derive(Debug, Clone)]
pub struct Trial {
    /// Step, ms.
    pub dt_ms: f64,
    /// Rung of the manipulator ladder, by its scene name.
    pub rung: &'static str,
    /// Voxel removal rule, by its scene name.
    pub removal: &'static str,
    /// Friction coefficient of the tendons in their channels.
    pub tendon_friction: f64,
    /// Friction coefficient between tool and bone.
    pub contact_friction: f64,
    /// Factor applied to all flexure stiffnesses.
    pub stiffness: f64,
    /// Tension of tendon 0, N.
    pub tension_n: f64,
    /// Feed, mm/s.
    pub feed_mm_per_s: f64,
    /// Length of the feed, mm.
    pub insertion_mm: f64,
    /// Burr speed, rpm.
    pub burr_rpm: f64,
    /// Text of a tool file, in place of the standard tool. A tool in an outer tube is deployed at the feed;
    /// any other is fed by the arm.
    pub tool: Option<String>,
    /// Drilling law, by its scene name; `None` for the default one.
    pub law: Option<&'static str>,
    /// Edge force in N per mm of the hole's diameter at 1900 kg/m³, and the exponent of the density; `None`
    /// for no edge force.
    pub edge_law: Option<[f64; 2]>,
    /// Compressive strength of cortical bone, MPa, replacing the standard law's.
    pub strength_mpa: Option<f64>,
    /// Whether the scene drills a pilot hole for the flexible part.
    pub pilot: bool,
}

impl Trial {
    /// The published experiment's tool: 2250 rpm (Alambeigi et al. 2017).
    pub fn new(tension_n: f64, feed_mm_per_s: f64, insertion_mm: f64) -> Trial {
        Trial {
            dt_ms: 5.0,
            rung: "planar",
            removal: "energy",
            tendon_friction: 0.1,
            contact_friction: 0.2,
            stiffness: 1.0,
            tension_n,
            feed_mm_per_s,
            insertion_mm,
            burr_rpm: 2250.0,
            tool: None,
            law: None,
            edge_law: None,
            strength_mpa: None,
            pilot: true,
        }
    }

    fn scene(&self) -> Result<Scene, Failure> {
        let pilot = if self.pilot {
            "[[predrill]]\nfrom_mm = [0.0, 0.0, -60.0]\nto_mm = [0.0, 0.0, 0.0]\ndiameter_mm = 7.0\n"
        } else {
            ""
        };
        let law = self.law.map_or_else(String::new, |law| format!("law = \"{law}\"\n"));
        // The friction of the tendons, if the tool has some.
        let tool = match &self.tool {
            Some(_) => "file = \"tool.toml\"\n".to_owned(),
            None => format!("tendon_friction = {:?}\n", self.tendon_friction),
        };
        let drives = if self.deploys() { "tube" } else { "tendon" };
        let edge = self.edge_law.map_or_else(String::new, |[force, exponent]| {
            format!("edge_force_n_per_mm = {force:?}\nedge_exponent = {exponent:?}\n")
        });
        let strength = self.strength_mpa.map_or_else(String::new, |mpa| format!("strength_mpa = {mpa:?}\n"));
        let text = format!(
            "name = \"reproduce\"\n[run]\nmode = \"lockstep\"\ndt_ms = {:?}\nduration_s = 10.0\n\
             [volume]\nphantom = \"block\"\nbone_threshold_hu = {THRESHOLD_HU}\n{pilot}\
             [manipulator]\nmodel = \"{}\"\n{tool}stiffness_scale = {:?}\n\
             [contact]\nfriction = {:?}\n{strength}[drilling]\nremoval = \"{}\"\n{law}{edge}\
             [tool]\nburr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, \
             0.0]\n\
             [[controller]]\nname = \"feed\"\ndrives = [\"{drives}\", \"arm\", \"burr\"]\nexternal = true\n",
            self.dt_ms, self.rung, self.stiffness, self.contact_friction, self.removal
        );
        let read = |_: &Path| -> std::io::Result<String> { Ok(self.tool.clone().unwrap_or_default()) };
        let scene = Scene::parse_with(&text, Path::new("reproduce.toml"), &read);
        let mut scene = scene.map_err(|cause| Failure::failed(cause.to_string()))?;
        // A rig has no protective stop.
        scene.arm.max_force_n = Some(UNLIMITED_N);
        Ok(scene)
    }

    fn deploys(&self) -> bool {
        self.tool.as_ref().is_some_and(|tool| tool.contains("[outer_tube]"))
    }

    /// Returns the command for a tick, or `None` if the previous one still applies.
    fn command(&self, time_s: f64, dt_s: f64) -> Option<Command> {
        if time_s >= RAMP_S + dt_s {
            return None;
        }
        let feeding = time_s >= RAMP_S;
        let (pulls, inserts, slides) =
            (self.tool.is_none(), feeding && !self.deploys(), feeding && self.deploys());
        Some(Command {
            tendon_mode: if pulls { TendonMode::ServoJf } else { TendonMode::None }.code(),
            tendon_force_n: [self.tension_n * (time_s / RAMP_S).min(1.0), 0.0, 0.0, 0.0],
            burr_mode: BurrMode::Speed.code(),
            burr_speed_rad_per_s: self.burr_rpm * core::f64::consts::TAU / 60.0,
            arm_mode: if inserts { ArmMode::Insert } else { ArmMode::None }.code(),
            tube_mode: if slides { TubeMode::MoveJp } else { TubeMode::None }.code(),
            tube_deployed_m: if slides { self.insertion_mm * 1e-3 } else { 0.0 },
            tube_speed_m_per_s: if slides { self.feed_mm_per_s * 1e-3 } else { 0.0 },
            arm_axis: [0.0, 0.0, 1.0],
            arm_depth_m: self.insertion_mm * 1e-3,
            arm_speed_m_per_s: self.feed_mm_per_s * 1e-3,
            ..Command::zeroed()
        })
    }

    /// Runs the trial; `see` is called with every state and the voxels removed in its tick.
    ///
    /// # Errors
    /// A scene or a step refused because a parameter of the trial is out of range.
    pub fn play(&self, block: &Block, mut see: impl FnMut(&State, &[u32])) -> Result<Outcome, Failure> {
        let failed = |cause: &dyn core::fmt::Display| Failure::failed(cause.to_string());
        let ct = CtView { geometry: block.geometry, hu: &block.hu };
        let scene = self.scene()?;
        let simulation = Simulation::new(&scene, Some(ct)).map_err(|cause| failed(&cause))?;
        let mut run = InProcess::new(&scene, simulation);
        let dt_s = self.dt_ms * 1e-3;
        let seconds = RAMP_S + self.insertion_mm / self.feed_mm_per_s + REST_S;
        let mut outcome = Outcome::new(run.plant().state());
        let ticks = (seconds / dt_s).ceil() as u64;
        for tick in 0..ticks {
            let answer = |_, _: &State, command: &mut Command| match self.command(tick as f64 * dt_s, dt_s) {
                None => Answer::Nothing,
                Some(new) => {
                    *command = Command { sequence: command.sequence, state_tick: command.state_tick, ..new };
                    Answer::Command
                }
            };
            run.tick(answer).map_err(|cause| failed(&cause))?;
            let simulation = run.plant();
            if let Some(refusal) = simulation.refusals().first() {
                return Err(Failure::failed(format!("a command was refused: {}", refusal.reason)));
            }
            let state = simulation.state();
            let feeding = tick as f64 * dt_s > RAMP_S && (tick as f64) * dt_s < seconds - REST_S;
            outcome.see(state);
            if feeding {
                outcome.see_feeding(state);
            }
            if feeding && tick * 2 > ticks {
                outcome.see_steady(state);
            }
            see(state, simulation.removed());
        }
        outcome.end = *run.plant().state();
        Ok(outcome)
    }
}

/// Results of a trial.
#[derive(Clone)]
pub struct Outcome {
    /// The last state.
    pub end: State,
    /// Largest normal force of the burr during the feed, N.
    pub most_force_n: f64,
    /// Mean normal force of the burr over the second half of the run, during the feed, N.
    pub mean_force_n: f64,
    /// Maximum penetration of any sphere into the bone, m.
    pub deepest_m: f64,
    /// Maximum sum of the walls' forces, and maximum force on the flange, N.
    pub most_wall_n: f64,
    pub most_flange_n: f64,
    /// Maximum ratio of a contact's force to its strength.
    pub most_share: f64,
    /// Maximum excess of a flexure beyond its stop, rad.
    pub past_stop_rad: f64,
    /// Maximum flexure speed during the feed, rad/s.
    pub fastest_rad_per_s: f64,
    /// Maximum number of loaded contacts in a tick.
    pub most_contacts: u32,
    samples: u64,
}

impl Outcome {
    fn new(state: &State) -> Outcome {
        Outcome {
            end: *state,
            most_force_n: 0.0,
            mean_force_n: 0.0,
            deepest_m: 0.0,
            most_wall_n: 0.0,
            most_flange_n: 0.0,
            most_share: 0.0,
            past_stop_rad: 0.0,
            fastest_rad_per_s: 0.0,
            most_contacts: 0,
            samples: 0,
        }
    }

    fn see(&mut self, state: &State) {
        let contacts = state.contacts.iter().take(state.contact_count as usize);
        self.deepest_m = contacts.map(|contact| -contact.gap_m).fold(self.deepest_m, f64::max);
        self.most_contacts = self.most_contacts.max(state.contact_count);
        self.most_wall_n = self.most_wall_n.max(state.wall_force_n);
        self.most_flange_n = self.most_flange_n.max(Vector3::from(state.flange_wrench.force_n).norm());
        self.most_share = self.most_share.max(state.strength_share);
        self.past_stop_rad = self.past_stop_rad.max(state.stop_excess_rad);
    }

    /// Takes a state during the feed.
    fn see_feeding(&mut self, state: &State) {
        self.most_force_n = self.most_force_n.max(state.burr_force_n);
        let rates = state.joint_velocity_rad_per_s.iter();
        self.fastest_rad_per_s = rates.map(|rate| rate.abs()).fold(self.fastest_rad_per_s, f64::max);
    }

    /// Takes a state of the feed in the second half of the run.
    fn see_steady(&mut self, state: &State) {
        self.samples += 1;
        self.mean_force_n += (state.burr_force_n - self.mean_force_n) / self.samples as f64;
    }

    /// Burr centre, m.
    pub fn burr_m(&self) -> Vector3<f64> {
        Vector3::from(self.end.t_world_burr.position_m)
    }

    /// Whether the reported numbers of the last state are finite.
    pub fn is_finite(&self) -> bool {
        self.burr_m().iter().all(|x| x.is_finite()) && self.end.bend_rad.is_finite()
    }
}
