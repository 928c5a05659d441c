//! CSV: a header line, then numbers; separated by commas, semicolons or tabs.

use std::io::{BufRead, BufReader, Read};
use std::path::Path;

use foreign_text::{foreign, foreign_path};

use super::{MAX_ROWS, no_column, opened, too_long};
use crate::failure::Failure;

/// Longest line, bytes.
const MAX_LINE_BYTES: u64 = 1 << 20;

/// Splits a line into its cells, without quotes and spaces around them.
fn cells(line: &str, separator: char) -> Vec<&str> {
    line.split(separator).map(|cell| cell.trim().trim_matches('"').trim()).collect()
}

/// Reads a cell: NaN if it is empty or says so. With semicolons, a decimal comma is read as a point.
fn number(cell: &str, separator: char) -> Option<f64> {
    let is_missing = ["", "nan", "na", "null", "none"].iter().any(|word| cell.eq_ignore_ascii_case(word));
    if is_missing {
        return Some(f64::NAN);
    }
    match separator {
        ';' if cell.contains(',') => cell.replace(',', ".").parse().ok(),
        _ => cell.parse().ok(),
    }
}

/// Reads columns by name.
pub(super) fn read(file: &Path, wanted: &[&str]) -> Result<Vec<Vec<f64>>, Failure> {
    let mut reader = BufReader::with_capacity(1 << 16, opened(file)?);
    let bad = |line: usize, why: String| {
        Failure::bad_input(format!("{}, line {line}: {why}", foreign_path(file)))
    };
    let mut line = String::new();
    let mut number_of_line = 0;
    let mut header: Option<(char, Vec<usize>)> = None;
    let mut columns = vec![Vec::new(); wanted.len()];
    loop {
        line.clear();
        number_of_line += 1;
        let read = reader.by_ref().take(MAX_LINE_BYTES).read_line(&mut line);
        let read = read.map_err(|cause| bad(number_of_line, format!("cannot be read ({cause})")))?;
        if read as u64 == MAX_LINE_BYTES {
            return Err(bad(number_of_line, format!("longer than {MAX_LINE_BYTES} bytes")));
        }
        if read == 0 {
            break;
        }
        let text = line.trim_start_matches('\u{feff}').trim_end_matches(['\r', '\n']);
        if text.trim().is_empty() || text.starts_with('#') {
            continue;
        }
        let Some((separator, places)) = &header else {
            let separator = [';', '\t', ','].into_iter().find(|c| text.contains(*c)).unwrap_or(',');
            let names = cells(text, separator);
            let place = |name: &&str| {
                let found = names.iter().position(|known| known == name);
                found.ok_or_else(|| no_column(file, name, &names))
            };
            header = Some((separator, wanted.iter().map(place).collect::<Result<_, _>>()?));
            continue;
        };
        if columns.first().is_some_and(|column| column.len() == MAX_ROWS) {
            return Err(too_long(file));
        }
        let cells = cells(text, *separator);
        for (column, place) in columns.iter_mut().zip(places) {
            let cell = cells.get(*place).copied().unwrap_or_default();
            let value = number(cell, *separator).ok_or_else(|| {
                bad(number_of_line, format!("column {} is `{}`, expected a number", place + 1, foreign(cell)))
            })?;
            column.push(value);
        }
    }
    match header {
        Some(_) => Ok(columns),
        None => Err(Failure::bad_input(format!("{}: no header line", foreign_path(file)))),
    }
}
