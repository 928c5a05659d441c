//! Output of a measurement: text lines as they are available, or with `--json` all figures as one object at
//! the end.

use serde_json::{Map, Value, json};
use trabecula::machine::Machine;
use trabecula::say::Figures;

use crate::bench::samples::Samples;

/// Collects the figures of a command, and prints its lines unless `--json` is set.
#[derive(Debug, Default)]
pub struct Sheet {
    figures: Figures,
    found: Map<String, Value>,
}

impl Sheet {
    /// Creates an empty sheet, printed as set by the command's options.
    pub fn new(figures: Figures) -> Sheet {
        Sheet { figures, found: Map::new() }
    }

    /// Prints a line without figures, or with figures that are set or pushed separately.
    pub fn line(&self, text: &str) {
        if !self.figures.json {
            say!("{text}");
        }
    }

    /// Prints a table row of name and value, and sets its figures.
    pub fn row(&mut self, name: &str, text: &str, key: &str, figures: Value) {
        self.line(&format!("{name:<46} {text}"));
        self.set(key, figures);
    }

    /// Same for durations.
    pub fn samples(&mut self, name: &str, key: &str, samples: &Samples) {
        self.row(name, &samples.line(), key, samples.figures());
    }

    /// Sets figures under a key.
    pub fn set(&mut self, key: &str, figures: Value) {
        self.found.insert(key.to_owned(), figures);
    }

    /// Appends an element to the list under a key.
    pub fn push(&mut self, key: &str, figures: Value) {
        match self.found.get_mut(key) {
            Some(Value::Array(list)) => list.push(figures),
            _ => self.set(key, json!([figures])),
        }
    }

    /// Collects the figures of a part under a separate key.
    pub fn within<T>(&mut self, key: &str, part: impl FnOnce(&mut Sheet) -> T) -> T {
        let mut inner = Sheet::new(self.figures);
        let result = part(&mut inner);
        self.set(key, Value::Object(inner.found));
        result
    }

    /// Adds the machine's load during a finished measurement.
    pub fn machine(&mut self, machine: &Machine) {
        let (busy_percent, stolen_percent) = machine.shares_percent();
        let cores = std::thread::available_parallelism().map_or(0, usize::from);
        let figures = json!({
            "cores": cores, "busy_percent": busy_percent, "stolen_percent": stolen_percent,
            "wall_s": machine.seconds(),
        });
        self.row("machine during the measurement", &machine.summary(), "machine", figures);
    }

    /// Whether any figures have been collected.
    pub fn has_figures(&self) -> bool {
        !self.found.is_empty()
    }

    /// Prints the object with `--json`. Also called by a measurement that fails after collecting figures.
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
