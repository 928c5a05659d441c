//! `.fcsv`: point lists, as written by Slicer before version 5 and still supported.

use crate::error::MarkupsError;
use crate::markup::{Frame, Kind, Markup, POSITION, Point, position};

const FRAME: &str = "LPS or RAS (in files before Slicer 4.11: 1 or 0): the frame of the positions is not \
                     assumed; IJK refers to a \
                     volume that the file does not name";

/// Columns of a file that does not list them, the same in all versions.
const COLUMNS: &str = "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID";

/// Indices of the columns used.
struct Columns {
    position: [usize; 3],
    label: usize,
}

/// Reads a file's text.
pub(crate) fn read(text: &str) -> Result<Markup, MarkupsError> {
    let mut frame = None;
    let mut columns = COLUMNS.to_owned();
    let mut rows = Vec::new();
    for (number, line) in text.lines().enumerate().map(|(index, line)| (index + 1, line.trim())) {
        match line.strip_prefix('#').map(|comment| comment.split_once('=')) {
            None if line.is_empty() => {}
            None => rows.push((number, line)),
            Some(Some((key, value))) if key.trim() == "CoordinateSystem" => {
                frame = Some(frame_of(number, value.trim())?);
            }
            Some(Some((key, value))) if key.trim() == "columns" => value.trim().clone_into(&mut columns),
            Some(_) => {}
        }
    }
    let missing = || MarkupsError::Missing { field: "# CoordinateSystem = ".to_owned(), expected: FRAME };
    let frame = frame.ok_or_else(missing)?;
    let columns = Columns::of(&columns)?;
    let points = rows.into_iter().map(|(number, row)| point(number, row, &columns, frame));
    Ok(Markup { kind: Kind::Points, frame, points: points.collect::<Result<_, _>>()? })
}

fn frame_of(number: usize, value: &str) -> Result<Frame, MarkupsError> {
    let frame = match value {
        "0" => Some(Frame::Ras),
        "1" => Some(Frame::Lps),
        name => Frame::of_name(name),
    };
    let field = format!("line {number}: # CoordinateSystem");
    frame.ok_or_else(|| MarkupsError::Field { field, given: value.to_owned(), expected: FRAME })
}

impl Columns {
    fn of(names: &str) -> Result<Columns, MarkupsError> {
        let find = |wanted: &str| names.split(',').position(|name| name.trim() == wanted);
        let all = [find("x"), find("y"), find("z"), find("label")];
        let [Some(x), Some(y), Some(z), Some(label)] = all else {
            return Err(MarkupsError::Field {
                field: "# columns".to_owned(),
                given: names.to_owned(),
                expected: "columns x, y, z and label among them",
            });
        };
        Ok(Columns { position: [x, y, z], label })
    }
}

fn point(number: usize, row: &str, columns: &Columns, frame: Frame) -> Result<Point, MarkupsError> {
    let cells = cells(row);
    let given = columns.position.map(|column| cells.get(column).map_or("", |cell| cell.trim()));
    let numbers = given.map(|cell| cell.parse::<f64>().unwrap_or(f64::NAN));
    let place = position(frame, numbers).ok_or_else(|| MarkupsError::Field {
        field: format!("line {number}: x, y, z"),
        given: format!("[{}]", given.join(", ")),
        expected: POSITION,
    })?;
    let label = cells.get(columns.label).map_or("", |cell| cell.trim()).to_owned();
    Ok(Point { label, position_mm: Some(place), status: "defined".to_owned() })
}

/// Splits a row into cells. A cell with a comma or a quote is quoted, and a quote in it doubled.
fn cells(row: &str) -> Vec<String> {
    let mut cells = vec![String::new()];
    let mut quoted = false;
    let mut characters = row.chars().peekable();
    while let Some(character) = characters.next() {
        match character {
            '"' if quoted && characters.peek() == Some(&'"') => {
                characters.next();
                push(&mut cells, '"');
            }
            '"' => quoted = !quoted,
            ',' if !quoted => cells.push(String::new()),
            other => push(&mut cells, other),
        }
    }
    cells
}

fn push(cells: &mut [String], character: char) {
    if let Some(cell) = cells.last_mut() {
        cell.push(character);
    }
}
