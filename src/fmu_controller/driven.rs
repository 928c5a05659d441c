//! Steps an FMU and answers the states of a session.

use std::path::Path;
use std::time::Duration;

use ipc_types::messages::{Command, SensorReading, State};
use run_log::columns::Column;
use run_log::fields::Scalar;
use trabecula_client::{Client, ClientError};
use trabecula_fmu::FmuError;
use trabecula_fmu::master::{Archived, Master};
use zerocopy::{FromBytes, IntoBytes};

use super::connections::{Connections, Source};
use crate::failure::Failure;

/// Longest wait for a state: a paused run publishes none.
const LONGEST_WAIT: Duration = Duration::from_secs(1);

/// An FMU that answers states.
pub(super) struct Driven<'a> {
    archived: &'a Archived,
    folder: &'a Path,
    connections: &'a Connections,
    /// Ticks in a step.
    every: u64,
    dt_s: f64,
    /// `None` until a state has arrived, and while an instance is replaced.
    instance: Option<Instance>,
    /// Newest reading of each sensor, and those that belong to states not yet taken.
    newest: Vec<SensorReading>,
    pending: Vec<SensorReading>,
}

/// A running instance of the FMU.
struct Instance {
    master: Master,
    /// Tick of the state at which its time is 0.
    first: u64,
    /// Steps done.
    steps: u64,
    last_tick: u64,
    /// What the last step commands.
    command: Command,
}

impl<'a> Driven<'a> {
    /// Prepares an extracted FMU, and creates an instance of it, so that errors show at the start.
    ///
    /// # Errors
    /// The FMU fails.
    pub fn new(
        archived: &'a Archived,
        folder: &'a Path,
        connections: &'a Connections,
        (every, dt_s): (u64, f64),
    ) -> Result<Driven<'a>, Failure> {
        let mut driven = Driven {
            archived,
            folder,
            connections,
            every,
            dt_s,
            instance: None,
            newest: Vec::new(),
            pending: Vec::new(),
        };
        driven.begin(None).map_err(Failure::failed)?;
        Ok(driven)
    }

    /// Answers every state until the run ends.
    ///
    /// # Errors
    /// The FMU or the session fails.
    pub fn answer_all(mut self, client: &mut Client) -> Result<(), Failure> {
        self.newest = vec![SensorReading::zeroed(); client.scene().sensor.len()];
        loop {
            let state = match client.wait_state(LONGEST_WAIT) {
                Ok(state) => *state,
                Err(ClientError::TimedOut(_)) => continue,
                Err(ClientError::Ended) => return Ok(()),
                Err(other) => return Err(Failure::failed(other)),
            };
            while let Some(reading) = client.next_reading().map_err(Failure::failed)? {
                self.pending.push(*reading);
            }
            let commanded = self.answer(&state).map_err(Failure::failed)?;
            let command = client.command().map_err(Failure::failed)?;
            let Command { sequence, state_tick, .. } = *command;
            *command = Command { sequence, state_tick, ..commanded };
            client.send().map_err(Failure::failed)?;
        }
    }

    /// Replaces the instance by a new one, whose time is 0 at `first`.
    fn begin(&mut self, first: Option<u64>) -> Result<&mut Instance, FmuError> {
        // Some FMUs allow only one instance in a process.
        self.instance = None;
        let master = Master::new(self.archived, self.folder)?;
        let mut parameters = self.connections.parameters.iter();
        parameters.try_for_each(|(variable, value)| master.set(variable, *value))?;
        master.enter_initialisation()?;
        master.exit_initialisation()?;
        let (first, last_tick) = (first.unwrap_or(u64::MAX), 0);
        Ok(self.instance.insert(Instance { master, first, steps: 0, last_tick, command: Command::zeroed() }))
    }

    /// Takes the readings that have arrived up to a tick.
    fn take_readings(&mut self, tick: u64) {
        let newest = &mut self.newest;
        self.pending.retain(|reading| {
            if reading.tick > tick {
                return true;
            }
            if let Some(place) = newest.get_mut(reading.sensor_index as usize) {
                *place = *reading;
            }
            false
        });
    }

    /// Returns the command for a state: steps the FMU if a step is due, and repeats its last command
    /// otherwise.
    fn answer(&mut self, state: &State) -> Result<Command, FmuError> {
        let is_back = self.instance.as_ref().is_some_and(|instance| state.tick < instance.last_tick);
        if is_back {
            // The run was reset.
            self.newest.fill(SensorReading::zeroed());
            self.begin(Some(state.tick))?;
        }
        self.take_readings(state.tick);
        let (every, dt_s, connections) = (self.every, self.dt_s, self.connections);
        let instance = self.instance.as_mut().ok_or(FmuError::Defect)?;
        instance.last_tick = state.tick;
        instance.first = instance.first.min(state.tick);
        let due = instance.first + instance.steps * every;
        if state.tick < due {
            return Ok(instance.command);
        }
        if state.tick >= due + every {
            // States were missed in real time: the FMU's steps still follow one another.
            instance.first += state.tick - due;
        }
        for (variable, source) in &connections.inputs {
            let value = match source {
                Source::State(column) => column.value(state.as_bytes()),
                Source::Reading(index, column) => column.value(self.newest[*index].as_bytes()),
            };
            instance.master.set(variable, value.map_or(0.0, Scalar::nearest_f64))?;
        }
        let step_s = every as f64 * dt_s;
        instance.master.step(instance.steps as f64 * step_s, step_s)?;
        instance.steps += 1;
        instance.command = commanded(connections, &instance.master)?;
        Ok(instance.command)
    }
}

fn commanded(connections: &Connections, master: &Master) -> Result<Command, FmuError> {
    let mut bytes = [0; size_of::<Command>()];
    for (column, variable) in &connections.outputs {
        put(column, &mut bytes, master.get(variable)?);
    }
    connections.constants.iter().for_each(|(column, value)| put(column, &mut bytes, *value));
    Command::read_from_bytes(&bytes).map_err(|_| FmuError::Defect)
}

/// Writes a value; a mode is rounded.
fn put(column: &Column, bytes: &mut [u8], value: f64) {
    if !column.set(bytes, value) {
        column.set_whole(bytes, value.round() as u32);
    }
}
