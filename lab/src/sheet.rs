//! What a measurement finds: lines for people as they come, or with `--json` all figures as one object at its
//! end.

use serde_json::{Map, Value, json};
use trabecula::machine::Machine;
use trabecula::say::Figures;

use crate::bench::samples::Samples;

/// Collects the figures of a command, and prints its lines if they are for people.
#[derive(Debug, Default)]
pub struct Sheet {
    figures: Figures,
    found: Map<String, Value>,
}

impl Sheet {
    /// An empty sheet, printed as the command's options say.
    pub fn new(figures: Figures) -> Sheet {
        Sheet { figures, found: Map::new() }
    }

    /// A line that holds no figure, or only such as are set or pushed.
    pub fn line(&self, text: &str) {
        if !self.figures.json {
            say!("{text}");
        }
    }

    /// One line of a table of names and values, and its figures.
    pub fn row(&mut self, name: &str, text: &str, key: &str, figures: Value) {
        self.line(&format!("{name:<46} {text}"));
        self.set(key, figures);
    }

    /// The same of durations.
    pub fn samples(&mut self, name: &str, key: &str, samples: &Samples) {
        self.row(name, &samples.line(), key, samples.figures());
    }

    /// Figures under a key.
    pub fn set(&mut self, key: &str, figures: Value) {
        self.found.insert(key.to_owned(), figures);
    }

    /// One more element of the list under a key.
    pub fn push(&mut self, key: &str, figures: Value) {
        match self.found.get_mut(key) {
            Some(Value::Array(list)) => list.push(figures),
            _ => self.set(key, json!([figures])),
        }
    }

    /// Figures of a part, under a key of its own.
    pub fn within<T>(&mut self, key: &str, part: impl FnOnce(&mut Sheet) -> T) -> T {
        let mut inner = Sheet::new(self.figures);
        let result = part(&mut inner);
        self.set(key, Value::Object(inner.found));
        result
    }

    /// What the machine did during a finished measurement.
    pub fn machine(&mut self, machine: &Machine) {
        let (busy_percent, stolen_percent) = machine.shares_percent();
        let cores = std::thread::available_parallelism().map_or(0, usize::from);
        let figures = json!({
            "cores": cores, "busy_percent": busy_percent, "stolen_percent": stolen_percent, "wall_s": machine.seconds(),
        });
        self.row("machine during the measurement", &machine.summary(), "machine", figures);
    }

    /// Whether anything has been found.
    pub fn has_figures(&self) -> bool {
        !self.found.is_empty()
    }

    /// Prints the object if it is for programs. A measurement that fails after it has found something calls
    /// this, too.
    pub fn end(self) {
        if self.figures.json {
            say!("{}", Value::Object(self.found));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_one_object_and_repeated_ones_a_list() {
        let mut sheet = Sheet::new(Figures { json: true });
        sheet.row("step", "1.5 us", "step_us", json!(1.5));
        sheet.push("poses", json!({"ms": 1}));
        sheet.push("poses", json!({"ms": 2}));
        assert_eq!(Value::Object(sheet.found), json!({"step_us": 1.5, "poses": [{"ms": 1}, {"ms": 2}]}));
    }
}
