//! Points from a CSV file: the first line has the keys, each further line the values of a point as TOML.

use std::path::Path;

use toml::Value;

use crate::error::StudyError;
use crate::parameter::is_not_finite;
use crate::study::{MAX_PARAMETERS, MAX_POINTS};

/// Keys and rows.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Table {
    pub keys: Vec<String>,
    pub rows: Vec<Vec<Value>>,
}

impl Table {
    /// # Errors
    /// Lines of different length, values that are not TOML, no rows, or too many.
    pub fn parse(text: &str, file: &Path) -> Result<Table, StudyError> {
        let bad = |line: usize, problem: String| StudyError::Table { file: file.to_owned(), line, problem };
        let mut lines = (1..).zip(text.lines()).filter(|(_, line)| !line.trim().is_empty());
        let (first, header) =
            lines.next().ok_or_else(|| bad(1, "is empty, expected a line of keys".to_owned()))?;
        let keys: Vec<String> = header.split(',').map(|key| key.trim().to_owned()).collect();
        if keys.len() > MAX_PARAMETERS {
            return Err(bad(first, format!("{} keys, expected at most {MAX_PARAMETERS}", keys.len())));
        }
        let mut rows = Vec::new();
        for (number, line) in lines {
            if rows.len() as u64 == MAX_POINTS {
                return Err(bad(number, format!("more than {MAX_POINTS} points")));
            }
            // The TOML parser splits at commas outside strings and lists.
            let list = format!("row = [{line}]").parse::<toml::Table>();
            let row = match list.ok().and_then(|mut table| table.remove("row")) {
                Some(Value::Array(row)) => row,
                _ => {
                    return Err(bad(
                        number,
                        "not a list of TOML values; strings need quotes, as in \"planar\"".to_owned(),
                    ));
                }
            };
            if row.len() != keys.len() {
                return Err(bad(
                    number,
                    format!("{} values, but the first line has {} keys", row.len(), keys.len()),
                ));
            }
            if row.iter().any(is_not_finite) {
                return Err(bad(number, "contains a non-finite number".to_owned()));
            }
            rows.push(row);
        }
        if rows.is_empty() {
            return Err(bad(first, "keys without any points".to_owned()));
        }
        Ok(Table { keys, rows })
    }
}
