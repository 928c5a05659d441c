//! What makes a flight recorder save its log: events, late ticks, a field of the state beyond a value.

use foreign_text::nearest_name;
use messages::layout::{Element, Message};
use messages::{Code, Event, EventCode, State, TickTiming};
use zerocopy::IntoBytes;

use crate::fields::{FieldLocation, Scalar, find};
use crate::misses::{Cause, attribute};

/// A late tick, as a trigger; `missed_tick:CAUSE` only for one main cause.
const MISSED_TICK: &str = "missed_tick";

/// A condition on the messages of a run.
#[derive(Debug, Clone)]
enum Condition {
    Event(EventCode),
    MissedTick(Option<Cause>),
    Field { location: FieldLocation, ros_type: &'static str, is_above: bool, value: f64 },
}

/// A trigger of a scene.
#[derive(Debug, Clone)]
struct Trigger {
    text: String,
    condition: Condition,
    /// Whether the last state met the condition, which triggers only once until it is no longer met.
    is_met: bool,
}

/// The triggers of a scene (`recording.triggers`).
#[derive(Debug, Clone, Default)]
pub struct Triggers(Vec<Trigger>);

impl Triggers {
    /// Parses the triggers.
    ///
    /// # Errors
    /// What is wrong with the first malformed one, and what is allowed.
    pub fn parse(texts: &[String]) -> Result<Triggers, String> {
        let parse = |text: &String| {
            let condition = Condition::parse(text).map_err(|why| format!("trigger `{text}`: {why}"))?;
            Ok(Trigger { text: text.clone(), condition, is_met: false })
        };
        texts.iter().map(parse).collect::<Result<_, String>>().map(Triggers)
    }

    /// Returns the triggers that this state is the first to meet, with the value that it has.
    pub fn state(&mut self, state: &State) -> Vec<String> {
        let mut met = Vec::new();
        for Trigger { text, condition, is_met } in &mut self.0 {
            let Condition::Field { location, ros_type, is_above, value } = condition else { continue };
            let beyond = location.scalars(ros_type, state.as_bytes()).find(|found| match is_above {
                true => found > value,
                false => found < value,
            });
            let was_met = std::mem::replace(is_met, beyond.is_some());
            met.extend(beyond.filter(|_| !was_met).map(|found| format!("{text} ({found})")));
        }
        met
    }

    /// Returns the trigger that an event meets.
    pub fn event(&self, event: &Event) -> Option<&str> {
        let code = event.code().ok()?;
        self.first(|condition| matches!(condition, Condition::Event(wanted) if *wanted == code))
    }

    /// Returns the trigger that a tick's timing meets.
    pub fn timing(&self, timing: &TickTiming) -> Option<&str> {
        let main_cause = attribute(timing)?.main_cause();
        self.first(|condition| match condition {
            Condition::MissedTick(cause) => cause.is_none_or(|cause| cause == main_cause),
            _ => false,
        })
    }

    fn first(&self, is_met: impl Fn(&Condition) -> bool) -> Option<&str> {
        self.0.iter().find(|trigger| is_met(&trigger.condition)).map(|trigger| trigger.text.as_str())
    }
}

impl Condition {
    fn parse(text: &str) -> Result<Condition, String> {
        if let Some(at) = text.find(['<', '>']) {
            let (path, value) = (text[..at].trim(), text[at + 1..].trim());
            let value: f64 = value.parse().ok().filter(|value: &f64| value.is_finite()).ok_or_else(|| {
                format!("`{value}` is not a number; expected a field, `<` or `>`, and a number")
            })?;
            let location = find(State::DESCRIPTION, path)?;
            let Element::Scalar(ros_type) = location.element else {
                return Err(format!("`{path}` is not a number; name one of its fields"));
            };
            let is_above = text[at..].starts_with('>');
            return Ok(Condition::Field { location, ros_type, is_above, value });
        }
        let (name, cause) = text.split_once(':').map_or((text, None), |(name, cause)| (name, Some(cause)));
        if name == MISSED_TICK {
            return cause.map(cause_of).transpose().map(Condition::MissedTick);
        }
        let event = event_codes().find(|code| code.word() == text);
        event.map(Condition::Event).ok_or_else(|| {
            let names = || std::iter::once(MISSED_TICK).chain(event_codes().map(EventCode::word));
            let near = nearest_name(text, names());
            let meant = near.map_or(String::new(), |near| format!(" (did you mean `{near}`?)"));
            let names = names().collect::<Vec<_>>().join(", ");
            format!("unknown{meant}; expected a field of the state with a limit (`burr_force_n > 20`) or one of {names}")
        })
    }
}

/// The events that can trigger: all but the one that a trigger causes.
fn event_codes() -> impl Iterator<Item = EventCode> {
    let code = |code: &Code| EventCode::try_from(code.number).ok();
    EventCode::CODES.iter().filter_map(code).filter(|code| *code != EventCode::LogSaved)
}

fn cause_of(name: &str) -> Result<Cause, String> {
    let word = |cause: Cause| cause.name().replace(' ', "_");
    Cause::ALL.into_iter().find(|cause| word(*cause) == name).ok_or_else(|| {
        let names = Cause::ALL.map(word).join(", ");
        format!("unknown cause `{name}`; expected one of {names}")
    })
}

impl FieldLocation {
    /// Reads the elements of the field from a message.
    fn scalars<'m>(&self, ros_type: &'static str, message: &'m [u8]) -> impl Iterator<Item = f64> + use<'m> {
        let count = self.array_length.unwrap_or(1).max(1);
        let bytes = message.get(self.offset..self.offset + self.size).unwrap_or_default();
        bytes
            .chunks_exact((self.size / count).max(1))
            .filter_map(move |element| Scalar::read(ros_type, element).map(Scalar::nearest_f64))
    }
}
