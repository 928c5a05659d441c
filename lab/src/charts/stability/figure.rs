//! The stability map: one column per case, one row per method; in each block, stiffness across, mass and step
//! size down.

use super::cases::Case;
use super::{Cell, DT_MS, MASS, STIFFNESS, Verdict};
use crate::charts::method::Method;
use figures::{Anchor, Figure, FigureError, HEAD, INK, RGBColor, Rect, TextSize, WIDTH, text_width};

/// Width of the methods' names.
const NAMES: f64 = 148.0;
/// Height of the legend under the title, and of the cases' names under the legend.
const LEGEND: f64 = 72.0;
const CASES: f64 = 56.0;
const LINE: f64 = 17.0;
const ROW: f64 = 6.0;
const GAP: f64 = 10.0;
/// Distinguishable with any colour vision, and by lightness in greyscale.
const COLOURS: [(Verdict, RGBColor, &str); 3] = [
    (Verdict::Converged, RGBColor(0, 158, 115), "within 0.2 mm of the converged solution"),
    (Verdict::Wrong, RGBColor(240, 200, 80), "not"),
    (Verdict::Blown, RGBColor(160, 30, 40), "blown up"),
];
const NONE: RGBColor = RGBColor(235, 235, 235);
/// Explanation of the positions in a block.
const INSIDE: [&str; 2] = [
    "In each block stiffness grows to the right: 1, 10, 100, 1000 times. Downwards three parts: mass 1, \
     1/10, 1/100;",
    "in each part the time step grows downwards: 0.5, 1, 2, 5, 10 ms.",
];

pub(super) fn draw(cells: &[Cell]) -> Result<Figure, FigureError> {
    let high = ROW * (MASS.len() * DT_MS.len()) as f64;
    let column = (WIDTH - NAMES - GAP) / Case::ALL.len() as f64;
    let top = HEAD + LEGEND + CASES;
    let height = top + (high + GAP) * Method::WITH_PROXIES.len() as f64;
    let mut figure = Figure::titled(height, "Stability: what becomes of a tool at rest")?;
    legend(&mut figure);
    for (index, case) in Case::ALL.into_iter().enumerate() {
        let middle = NAMES + (index as f64 + 0.5) * column - 0.5 * GAP;
        let lines = wrapped(case.key(), column - 2.0);
        for (line, text) in lines.iter().rev().enumerate() {
            figure.text(
                (middle, top - 10.0 - LINE * line as f64),
                text,
                TextSize::Label,
                INK,
                Anchor::Centre,
            );
        }
    }
    for (row, method) in Method::WITH_PROXIES.into_iter().enumerate() {
        let y = top + row as f64 * (high + GAP);
        figure.text((NAMES - 8.0, y + 0.5 * high), &method.name(), TextSize::Label, INK, Anchor::Right);
        for (index, case) in Case::ALL.into_iter().enumerate() {
            let place = Rect { x: NAMES + index as f64 * column, y, width: column - GAP, height: high };
            figure.rectangle(place, NONE);
            for cell in cells.iter().filter(|cell| cell.method == method && cell.case == case) {
                draw_cell(&mut figure, place, cell);
            }
        }
    }
    Ok(figure)
}

fn legend(figure: &mut Figure) {
    let mut x = 14.0;
    for (_, colour, name) in COLOURS {
        figure.rectangle(Rect { x, y: HEAD + 4.0, width: 18.0, height: 12.0 }, colour);
        figure.text((x + 25.0, HEAD + 10.0), name, TextSize::Label, INK, Anchor::Left);
        x += 51.0 + text_width(name, TextSize::Label);
    }
    for (line, text) in INSIDE.into_iter().enumerate() {
        let y = HEAD + 34.0 + 20.0 * line as f64;
        figure.text((14.0, y), text, TextSize::Label, INK, Anchor::Left);
    }
}

/// Splits a text into lines of at most this width, if its words allow it.
fn wrapped(text: &str, width: f64) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split(' ') {
        match lines.last_mut() {
            Some(line) if text_width(&format!("{line} {word}"), TextSize::Label) <= width => {
                *line = format!("{line} {word}");
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

/// Draws a cell in its block.
fn draw_cell(figure: &mut Figure, block: Rect, cell: &Cell) {
    let index = |all: &[f64], value: f64| all.iter().position(|own| *own == value).unwrap_or(0);
    let column = index(&STIFFNESS, cell.stiffness) as f64;
    let row = (index(&MASS, cell.mass) * DT_MS.len() + index(&DT_MS, cell.dt_ms)) as f64;
    let colour =
        COLOURS.iter().find(|(verdict, ..)| *verdict == cell.verdict).map_or(NONE, |(_, colour, _)| *colour);
    // A thin white gap between the masses.
    let height = if (row as usize + 1).is_multiple_of(DT_MS.len()) { ROW - 1.0 } else { ROW };
    let wide = block.width / STIFFNESS.len() as f64;
    let (x, y) = (block.x + column * wide, block.y + row * ROW);
    figure.rectangle(Rect { x, y, width: wide - 1.0, height }, colour);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_lies_over_anything() {
        assert_eq!(draw(&[]).unwrap().collisions(), []);
    }
}
