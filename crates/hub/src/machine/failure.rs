//! Why a run ends early, and which component is reported as the cause.

use std::fmt::Display;

use messages::{Blame, EventCode, Part, Tick};
use thiserror::Error;

use crate::run_lane::LaneError;

/// Why a run ends early.
#[derive(Debug, Error)]
pub enum HubError<E, P> {
    /// A message could not be sent or received.
    #[error("{0}")]
    Environment(E),
    /// The plant could not compute a tick; its commands have been published, but no state.
    #[error("tick {tick}: {cause}")]
    Plant {
        /// Tick.
        tick: Tick,
        /// Reason from the plant.
        cause: P,
    },
    /// A consumer never connected.
    #[error("{part} did not connect within {limit_s} s")]
    NotConnected {
        /// The part.
        part: Part,
        /// Time waited.
        limit_s: u64,
    },
    /// A controller is the cause.
    #[error("{0}")]
    Controller(ControllerFault),
    /// A consumer stopped taking states.
    #[error("{part} has taken no state for {limit_s} s at tick {tick}")]
    ConsumerStuck {
        /// The part.
        part: Part,
        /// Tick.
        tick: Tick,
        /// Limit.
        limit_s: u64,
    },
}

/// How a controller ends the run.
#[derive(Debug, Error)]
pub enum ControllerFault {
    /// It never sent an acceptable command.
    #[error("controller `{name}` {} within {limit_s} s{}", what_it_missed(refused), why(refused))]
    NotConnected {
        /// Its name.
        name: String,
        /// Time waited.
        limit_s: u64,
        /// Why its last command was refused, if it sent one.
        refused: Option<String>,
    },
    /// It did not answer in lockstep.
    #[error(
        "controller `{name}` did not answer tick {tick} within {limit_ms} ms (`run.controller_limit_ms`){}",
        why(refused)
    )]
    Silent {
        /// Its name.
        name: String,
        /// Tick.
        tick: Tick,
        /// Limit.
        limit_ms: f64,
        /// Why its last command was refused, if it was.
        refused: Option<String>,
    },
}

fn what_it_missed(refused: &Option<String>) -> &'static str {
    if refused.is_some() { "sent no valid command" } else { "did not connect" }
}

fn why(refused: &Option<String>) -> String {
    refused.as_ref().map_or(String::new(), |reason| format!("; its last command was refused: {reason}"))
}

impl ControllerFault {
    /// Returns the controller's name.
    pub fn controller(&self) -> &str {
        match self {
            ControllerFault::NotConnected { name, .. } | ControllerFault::Silent { name, .. } => name,
        }
    }

    /// Returns the code of the event that reports it.
    pub fn event(&self) -> EventCode {
        match self {
            ControllerFault::NotConnected { refused: None, .. } => EventCode::ControllerMissing,
            // A controller whose commands are refused is present.
            ControllerFault::NotConnected { .. } | ControllerFault::Silent { .. } => {
                EventCode::ControllerLate
            }
        }
    }
}

impl<E, P> From<E> for HubError<E, P> {
    fn from(cause: E) -> HubError<E, P> {
        HubError::Environment(cause)
    }
}

/// A failure that every client is notified of before the run ends: a controller or the plant has failed.
/// Failures of parts and the transport are left to the launcher, which detects them.
#[derive(Debug)]
pub(super) enum Failure<C> {
    Plant { tick: Tick, cause: C },
    Controller(ControllerFault),
}

impl<C: Display> Failure<C> {
    /// Extracts the failure from an error, or returns the error.
    pub(super) fn of<E>(error: HubError<E, C>) -> Result<Self, HubError<E, C>> {
        match error {
            HubError::Plant { tick, cause } => Ok(Failure::Plant { tick, cause }),
            HubError::Controller(fault) => Ok(Failure::Controller(fault)),
            other => Err(other),
        }
    }

    pub(super) fn error<E>(self) -> HubError<E, C> {
        match self {
            Failure::Plant { tick, cause } => HubError::Plant { tick, cause },
            Failure::Controller(fault) => HubError::Controller(fault),
        }
    }

    pub(super) fn blame(&self) -> Blame {
        match self {
            Failure::Plant { tick, cause } => Blame {
                code: EventCode::SimulationFailed,
                controller: None,
                text: format!("tick {tick}: {cause}"),
            },
            Failure::Controller(fault) => Blame {
                code: fault.event(),
                controller: Some(fault.controller().to_owned()),
                text: fault.to_string(),
            },
        }
    }
}

/// Turns an error of the run lane into the run's error.
pub(super) fn lane_failed<E, P>(tick: Tick) -> impl Fn(LaneError<E, P>) -> HubError<E, P> {
    move |cause| match cause {
        LaneError::Output(cause) => HubError::Environment(cause),
        LaneError::Plant(cause) => HubError::Plant { tick, cause },
    }
}
