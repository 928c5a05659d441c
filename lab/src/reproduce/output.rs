//! Tables and figures of a part.

use crate::effort::Effort;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use figures::{Figure, FigureError};
use trabecula::failure::Failure;
use trabecula::report::ReportError;

/// Output folder and effort.
pub struct Plan {
    /// Output folder.
    pub out: PathBuf,
    /// Quick: fewer cases and faster feeds, in seconds.
    pub effort: Effort,
}

impl Plan {
    /// Writes a figure as `<stem>.svg` and `<stem>.png`.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn draw(&self, figure: Result<Figure, FigureError>, stem: &str) -> Result<(), Failure> {
        let written = figure.and_then(|figure| figure.write(&self.out, stem));
        Ok(written.map_err(ReportError::from)?)
    }
}

/// A table, printed and saved as CSV.
pub struct Table {
    head: Vec<&'static str>,
    rows: Vec<Vec<String>>,
}

impl Table {
    /// Creates a table with these column names.
    pub fn new(head: &[&'static str]) -> Table {
        Table { head: head.to_vec(), rows: Vec::new() }
    }

    /// Adds a row.
    pub fn row(&mut self, cells: Vec<String>) {
        self.rows.push(cells);
    }

    /// Prints the table and writes it as CSV.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(&self, folder: &Path, name: &str) -> Result<(), Failure> {
        let width = |column: usize| {
            let cells = self.rows.iter().filter_map(|row| row.get(column)).map(|cell| cell.chars().count());
            cells.chain([self.head[column].len()]).max().unwrap_or(0)
        };
        let widths: Vec<usize> = (0..self.head.len()).map(width).collect();
        let line = |cells: &[&str]| {
            let mut text = String::new();
            for (cell, width) in cells.iter().zip(&widths) {
                // Writing to a String cannot fail.
                let _ = write!(text, "{cell:>width$}  ");
            }
            text.trim_end().to_owned()
        };
        say!("{}", line(&self.head));
        let mut csv = self.head.join(",") + "\n";
        for row in &self.rows {
            let cells: Vec<&str> = row.iter().map(String::as_str).collect();
            say!("{}", line(&cells));
            csv.push_str(&(cells.join(",") + "\n"));
        }
        let path = folder.join(name);
        Ok(output_file::write(&path, csv)?)
    }
}
