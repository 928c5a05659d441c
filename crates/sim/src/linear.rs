//! Linear models of a tick, from central differences.
//!
//! About the present state x₀ and the commands u₀ of the next tick:
//!
//! ```text
//! x[k+1] - f(x₀, u₀) = A (x[k] - x₀) + B (u[k] - u₀)
//! y[k]   - g(x₀, u₀) = C (x[k] - x₀) + D (u[k] - u₀)
//! ```
//!
//! with the state vector of [`Sim::state_entries`], the bone as it is, and the contacts of the tick. Outputs
//! that follow from the state alone (poses, angles, rates) are those of state k, so their rows of D are 0.
//! Forces, tensions and the burr's speed are computed by tick k, and are those of state k+1. Nothing is cut,
//! so energies do not change.
//!
//! A difference moves one entry by [`StateEntry::difference`], or one input by a difference of its unit, to
//! both sides; at the end of a range to one side. Rates and accelerations of the arm's joints and of the tube
//! have columns of 0: their drives follow plans of limited jerk, which have no derivative where they begin.
//! The contact solver then stops at [`TOLERANCE_M_PER_S`], so that its remainder is below the differences.

use messages::layout::Message;
use messages::{Command, CommandSource, Latched, MAX_CONTROLLERS, State, USED_LENGTHS};
use run_log::columns::{Column, columns};
use scene::{Drives, Scene};
use simulation::{Simulation, SimulationError, SimulationSnapshot, StateEntry};
use zerocopy::{FromBytes, IntoBytes};

use crate::error::SimError;
use crate::simulator::Sim;

/// Speed by which contacts may violate their law in a tick from which differences are taken.
const TOLERANCE_M_PER_S: f64 = 1e-13;

/// Name and unit of a state, an input or an output; the unit is empty for a plain number.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Signal {
    /// Name: of a state, or the path of a field of a command or a state, such as `tendon_force_n[0]`.
    pub name: String,
    /// Unit.
    pub unit: &'static str,
}

/// One tick as a linear model.
#[derive(Debug, Clone, PartialEq)]
pub struct LinearModel {
    /// Tick of the state about which it holds.
    pub tick: u64,
    /// Simulated time of a tick.
    pub dt_s: f64,
    /// The n states.
    pub states: Vec<Signal>,
    /// The m inputs.
    pub inputs: Vec<Signal>,
    /// The p outputs.
    pub outputs: Vec<Signal>,
    /// A, n x n, row by row.
    pub a: Vec<f64>,
    /// B, n x m.
    pub b: Vec<f64>,
    /// C, p x n.
    pub c: Vec<f64>,
    /// D, p x m.
    pub d: Vec<f64>,
    /// x₀.
    pub state: Vec<f64>,
    /// f(x₀, u₀).
    pub next_state: Vec<f64>,
    /// u₀.
    pub input: Vec<f64>,
    /// g(x₀, u₀).
    pub output: Vec<f64>,
    /// Where a contact, a stop or a tendon's friction differs within a difference, so that a derivative is
    /// the mean of two; and inputs without effect.
    pub notes: Vec<String>,
}

impl Sim {
    /// Returns the next tick, with these commands as for [`Sim::step`], as a linear model about the present
    /// state. `inputs` are fields of commands and `outputs` fields of states; an array stands for its used
    /// elements. The simulation stays as it is.
    ///
    /// # Errors
    /// As [`Sim::step`]; also if there is no such field, a field is no `float64`, or no controller drives
    /// what an input belongs to.
    pub fn linearize(
        &mut self,
        commands: &[Command],
        inputs: &[String],
        outputs: &[String],
    ) -> Result<LinearModel, SimError> {
        let state = *self.state();
        let outputs = output_columns(&state, outputs)?;
        let inputs = input_columns(self.shared.scene(), &state, inputs)?;
        let dt_s = self.shared.scene().dt_s();
        self.at_next_tick(commands, |plant, here, latched| {
            let usual = plant.set_contact_tolerance(TOLERANCE_M_PER_S);
            plant.freeze_bone(true);
            let (entries, bone) = (plant.state_entries(), plant.bone_changes());
            let mut tick =
                OneTick { plant, here, entries: &entries, outputs: &outputs, bone, all_after: false };
            let model = tick.model(latched, &inputs, dt_s);
            plant.set_contact_tolerance(usual);
            plant.freeze_bone(false);
            model
        })
    }
}

impl Sim {
    /// Returns the derivative of outputs of the state after the next tick by inputs of that tick, outputs by
    /// inputs, row by row: D of a model whose outputs are all computed by the tick.
    ///
    /// # Errors
    /// As [`Sim::linearize`].
    pub fn output_derivatives(
        &mut self,
        commands: &[Command],
        inputs: &[String],
        outputs: &[String],
    ) -> Result<Vec<f64>, SimError> {
        let state = *self.state();
        let outputs = output_columns(&state, outputs)?;
        let inputs = input_columns(self.shared.scene(), &state, inputs)?;
        let width = inputs.len();
        self.at_next_tick(commands, |plant, here, latched| {
            let usual = plant.set_contact_tolerance(TOLERANCE_M_PER_S);
            plant.freeze_bone(true);
            let (entries, bone) = (plant.state_entries(), plant.bone_changes());
            let vector = plant.state_vector();
            let mut tick =
                OneTick { plant, here, entries: &entries, outputs: &outputs, bone, all_after: true };
            let mut derivatives = vec![0.0; outputs.len() * width];
            let mut run = || {
                for (j, input) in inputs.iter().enumerate() {
                    let (sides, distance) = tick.by_input(&vector, latched, input)?;
                    column([(&mut Vec::new(), 0), (&mut derivatives, width)], j, &sides, distance);
                }
                Ok(())
            };
            let done = run();
            plant.set_contact_tolerance(usual);
            plant.freeze_bone(false);
            done.map(|()| derivatives)
        })
    }
}

/// Fields of a state that follow from the state vector; a tick computes the others.
const OF_THE_STATE: [&str; 12] = [
    "joint_",
    "bend_rad",
    "stop_excess_rad",
    "drive_shaft_wind_up_rad",
    "tube_",
    "t_world_base",
    "t_world_tip",
    "t_world_burr",
    "t_world_link",
    "t_world_flange",
    "arm_joint_",
    "arm_manipulability",
];

/// Returns how many elements of a field, by its name, a state of this scene uses; `None` for a field that is
/// no array or uses all of them.
pub fn used_elements(field: &str, state: &State) -> Option<u32> {
    // Arrays of a command have the names of those of a state, except for these.
    let field = match field {
        "tendon_force_n" => "tendon_tension_n",
        "tendon_velocity_m_per_s" => "tendon_displacement_m",
        _ => field,
    };
    match USED_LENGTHS.iter().find(|(of, name, _)| (*of, *name) == ("State", field))?.2 {
        "joint_count" => Some(state.joint_count),
        "tendon_count" => Some(state.tendon_count),
        "arm_joint_count" => Some(state.arm_joint_count),
        "body_count" => Some(state.body_count),
        "contact_count" => Some(state.contact_count),
        _ => Some(state.controller_count),
    }
}

/// Returns whether a column is a used element, or of no array.
fn is_used(column: &Column, state: &State) -> bool {
    let field = column.name.split('.').next().unwrap_or_default();
    let Some((array, rest)) = field.split_once('[') else { return true };
    let Some(count) = used_elements(array, state) else { return true };
    rest.trim_end_matches(']').parse().is_ok_and(|index: u32| index < count)
}

fn signal(column: &Column) -> Signal {
    Signal { name: column.name.clone(), unit: column.unit() }
}

fn refused(kind: &'static str, name: &str, reason: String) -> SimError {
    SimError::NoSignal { kind, name: name.to_owned(), reason }
}

fn floats(
    kind: &'static str,
    name: &str,
    found: Result<Vec<Column>, run_log::LogError>,
    state: &State,
) -> Result<Vec<Column>, SimError> {
    let found = found.map_err(|error| refused(kind, name, error.to_string()))?;
    if let Some(column) = found.iter().find(|column| column.ros_type != "float64") {
        return Err(refused(kind, name, format!("`{}` is a whole number", column.name)));
    }
    let used: Vec<Column> = found.into_iter().filter(|column| is_used(column, state)).collect();
    match used.is_empty() {
        true => Err(refused(kind, name, "this scene uses no element of it".to_owned())),
        false => Ok(used),
    }
}

fn output_columns(state: &State, names: &[String]) -> Result<Vec<Column>, SimError> {
    let of = |name: &String| {
        floats("output", name, columns(State::DESCRIPTION, std::slice::from_ref(name)), state)
    };
    Ok(names.iter().map(of).collect::<Result<Vec<_>, _>>()?.concat())
}

/// A field of a command, with the controller that sends it.
struct Input {
    column: Column,
    controller: usize,
}

fn input_columns(scene: &Scene, state: &State, names: &[String]) -> Result<Vec<Input>, SimError> {
    let mut inputs = Vec::new();
    for name in names {
        let found = columns(Command::DESCRIPTION, std::slice::from_ref(name));
        for column in floats("input", name, found, state)? {
            let part = part(&column.name);
            let drives = |entry: &scene::Controller| part.is_some_and(|part| entry.drives.contains(&part));
            let controller = scene.controller.iter().position(drives).ok_or_else(|| {
                refused("input", name, "no controller of the scene drives what it belongs to".to_owned())
            })?;
            if part == Some(Drives::Body) && scene.controller.iter().filter(|entry| drives(entry)).count() > 1
            {
                return Err(refused(
                    "input",
                    name,
                    "several controllers of the scene drive bodies".to_owned(),
                ));
            }
            inputs.push(Input { column, controller });
        }
    }
    Ok(inputs)
}

/// Returns the part of the tool that a field of a command drives.
fn part(field: &str) -> Option<Drives> {
    let of = [
        ("tendon_", Drives::Tendon),
        ("arm_", Drives::Arm),
        ("t_world_base", Drives::Arm),
        ("burr_", Drives::Burr),
        ("tube_", Drives::Tube),
        ("body_", Drives::Body),
        ("t_world_body_goal", Drives::Body),
    ];
    of.into_iter().find(|(prefix, _)| field.starts_with(prefix)).map(|(_, part)| part)
}

/// Returns a value moved within the range of an input: tendons do not push.
fn clamped(column: &Column, value: f64) -> f64 {
    if column.name.starts_with("tendon_force_n") { value.max(0.0) } else { value }
}

/// Returns the difference of an input.
fn difference(column: &Column) -> f64 {
    match column.unit() {
        "N" => 1e-4,
        "m" => 1e-8,
        "m/s" => 1e-6,
        "rad" => 1e-7,
        _ => 1e-5,
    }
}

/// What must be the same on both sides of a difference for the tick to be smooth between them.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
struct Regime {
    /// Spheres of the contacts that carry force.
    contacts: Vec<u32>,
    /// Number of flexures at their stops.
    stops: usize,
    /// Entries at an end of their range: tendons that slide.
    at_ends: Vec<usize>,
    /// Whether each tendon is taut.
    taut: Vec<bool>,
}

impl Regime {
    /// Says what differs between two regimes.
    fn change(&self, other: &Regime, entries: &[StateEntry]) -> Option<String> {
        if self.contacts != other.contacts {
            let spheres = |regime: &Regime| format!("{:?}", regime.contacts);
            return Some(format!("contacts change (spheres {} and {})", spheres(self), spheres(other)));
        }
        if self.stops != other.stops {
            return Some(format!("flexures at their stops change ({} and {})", self.stops, other.stops));
        }
        if let Some(tendon) = (0..self.taut.len()).find(|t| self.taut[*t] != other.taut[*t]) {
            return Some(format!("tendon {tendon} becomes slack or taut"));
        }
        let differing = self.at_ends.iter().chain(&other.at_ends);
        let mut differing = differing.filter(|i| !(self.at_ends.contains(i) && other.at_ends.contains(i)));
        differing
            .next()
            .map(|index| format!("`{}` reaches or leaves the end of its range", entries[*index].name))
    }
}

/// A tick's results.
struct Outcome {
    next: Vec<f64>,
    output: Vec<f64>,
    regime: Regime,
}

/// One tick, repeated from states near a snapshot.
struct OneTick<'t> {
    plant: &'t mut Simulation<'static>,
    here: &'t SimulationSnapshot,
    entries: &'t [StateEntry],
    outputs: &'t [Column],
    /// Number of the bone's changes at which it is the snapshot's.
    bone: u64,
    /// Whether all outputs are those after the tick.
    all_after: bool,
}

impl OneTick<'_> {
    fn run(&mut self, vector: &[f64], latched: &Latched) -> Result<Outcome, SimulationError> {
        if self.plant.bone_changes() == self.bone {
            self.plant.restore_beside_bone(self.here)?;
        } else {
            self.plant.restore(self.here)?;
            self.bone = self.plant.bone_changes();
        }
        self.plant.set_state_vector(vector)?;
        let before = *self.plant.state();
        self.plant.step(latched)?;
        let (next, after) = (self.plant.state_vector(), self.plant.state());
        let output = self.outputs.iter().map(|column| {
            let of_state =
                !self.all_after && OF_THE_STATE.iter().any(|prefix| column.name.starts_with(prefix));
            let state = if of_state { before.as_bytes() } else { after.as_bytes() };
            column.value(state).map_or(0.0, run_log::fields::Scalar::nearest_f64)
        });
        let at_end = |(entry, value): (&StateEntry, &f64)| entry.range.contains(value);
        let regime = Regime {
            contacts: after
                .contacts
                .iter()
                .take(after.contact_count as usize)
                .map(|it| it.sphere_index)
                .collect(),
            stops: self.plant.tool_report().stopped_joint_count,
            taut: after.tendon_tension_n[..after.tendon_count as usize].iter().map(|n| *n > 0.0).collect(),
            at_ends: (0..next.len()).filter(|i| at_end((&self.entries[*i], &next[*i]))).collect(),
        };
        Ok(Outcome { output: output.collect(), next, regime })
    }

    /// Returns the outcomes on both sides of an input's value, and the distance between them.
    fn by_input(
        &mut self,
        vector: &[f64],
        latched: &Latched,
        input: &Input,
    ) -> Result<(Vec<Outcome>, f64), SimulationError> {
        let (here, step) = (value(latched, input), difference(&input.column));
        let (mut sides, mut outcomes) = ([0.0; 2], Vec::with_capacity(2));
        for (side, sign) in sides.iter_mut().zip([-1.0, 1.0]) {
            let mut moved = *latched;
            *side = clamped(&input.column, here + sign * step);
            set_value(&mut moved, input, *side);
            outcomes.push(self.run(vector, &moved)?);
        }
        Ok((outcomes, sides[1] - sides[0]))
    }

    fn model(
        &mut self,
        latched: &Latched,
        inputs: &[Input],
        dt_s: f64,
    ) -> Result<LinearModel, SimulationError> {
        let entries = self.entries;
        let state = self.plant.state_vector();
        let on_path = self.plant.is_arm_on_path();
        let nominal = self.run(&state, latched)?;
        let (n, m, p) = (entries.len(), inputs.len(), self.outputs.len());
        let mut model = LinearModel {
            tick: latched.tick,
            dt_s,
            states: entries.iter().map(|it| Signal { name: it.name.clone(), unit: it.unit }).collect(),
            inputs: inputs.iter().map(|input| signal(&input.column)).collect(),
            outputs: self.outputs.iter().map(signal).collect(),
            a: vec![0.0; n * n],
            b: vec![0.0; n * m],
            c: vec![0.0; p * n],
            d: vec![0.0; p * m],
            state: state.clone(),
            next_state: nominal.next.clone(),
            input: inputs.iter().map(|input| value(latched, input)).collect(),
            output: nominal.output.clone(),
            notes: Vec::new(),
        };
        for (j, entry) in entries.iter().enumerate() {
            if entry.is_of_plan() || (on_path && entry.is_of_arm_joint()) {
                continue;
            }
            let mut sides = [0.0; 2];
            let mut outcomes = Vec::with_capacity(2);
            for (side, sign) in sides.iter_mut().zip([-1.0, 1.0]) {
                let mut moved = state.clone();
                moved[j] = (state[j] + sign * entry.difference).clamp(entry.range[0], entry.range[1]);
                *side = moved[j];
                outcomes.push(self.run(&moved, latched)?);
            }
            model.note(&entry.name, &outcomes, &nominal, entries);
            let places = [(&mut model.a, n), (&mut model.c, n)];
            column(places, j, &outcomes, sides[1] - sides[0]);
        }
        for (j, input) in inputs.iter().enumerate() {
            let (outcomes, distance) = self.by_input(&state, latched, input)?;
            let name = &input.column.name;
            model.note(name, &outcomes, &nominal, entries);
            if outcomes[0].next == outcomes[1].next && outcomes[0].output == outcomes[1].output {
                model.notes.push(format!("`{name}` has no effect: the mode of the command does not use it"));
            }
            column([(&mut model.b, m), (&mut model.d, m)], j, &outcomes, distance);
        }
        if on_path {
            let text = "the arm follows a path, which determines its joints: their columns of A and C are 0";
            model.notes.push(text.to_owned());
        }
        Ok(model)
    }
}

impl LinearModel {
    fn note(&mut self, name: &str, sides: &[Outcome], nominal: &Outcome, entries: &[StateEntry]) {
        let change = sides.iter().find_map(|side| nominal.regime.change(&side.regime, entries));
        if let Some(change) = change {
            self.notes.push(format!("`{name}`: {change} within the difference"));
        }
    }
}

/// Writes column `j` of the derivatives of next state and output.
fn column(places: [(&mut Vec<f64>, usize); 2], j: usize, sides: &[Outcome], distance: f64) {
    let [low, high] = sides else { return };
    let [(next, rows_of), (output, width)] = places;
    let rows = if rows_of == 0 { 0 } else { low.next.len() };
    for (i, (low, high)) in low.next.iter().zip(&high.next).take(rows).enumerate() {
        next[i * rows_of + j] = (high - low) / distance;
    }
    for (i, (low, high)) in low.output.iter().zip(&high.output).enumerate() {
        output[i * width + j] = (high - low) / distance;
    }
}

fn value(latched: &Latched, input: &Input) -> f64 {
    let bytes = latched.commands[input.controller].command.as_bytes();
    input.column.value(bytes).map_or(0.0, run_log::fields::Scalar::nearest_f64)
}

/// Sets the value, in a command that the tick applies.
fn set_value(latched: &mut Latched, input: &Input, value: f64) {
    let entry = &mut latched.commands[input.controller % MAX_CONTROLLERS];
    let mut bytes = [0; size_of::<Command>()];
    bytes.copy_from_slice(entry.command.as_bytes());
    if input.column.set(&mut bytes, value)
        && let Ok(command) = Command::read_from_bytes(&bytes)
    {
        entry.command = command;
        entry.source = CommandSource::Fresh.code();
    }
}
