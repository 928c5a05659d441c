//! The stability map: one column per case, one row per method; in each block, stiffness across, mass and step down.

use plotters::style::RGBColor;

use super::cases::Case;
use super::{Cell, DT_MS, MASS, STIFFNESS, Verdict};
use crate::charts::method::Method;
use trabecula::report::ReportError;
use trabecula::report::panel::{INK, Rect};
use trabecula::report::shapes::{Anchor, Figure, Shape};

const LEFT: f64 = 160.0;
const TOP: f64 = 96.0;
/// Size of a cell, and gap between blocks.
const SIZE: (f64, f64) = (24.0, 6.0);
const GAP: f64 = 12.0;
/// Distinguishable with any colour vision, and by lightness in greyscale.
const COLOURS: [(Verdict, RGBColor, &str); 3] = [
    (Verdict::Converged, RGBColor(0, 158, 115), "converged"),
    (Verdict::Wrong, RGBColor(240, 200, 80), "wrong"),
    (Verdict::Blown, RGBColor(160, 30, 40), "blown up"),
];
const NONE: RGBColor = RGBColor(235, 235, 235);

pub(super) fn draw(cells: &[Cell]) -> Result<Figure, ReportError> {
    let block = (SIZE.0 * STIFFNESS.len() as f64, SIZE.1 * (MASS.len() * DT_MS.len()) as f64);
    let width = LEFT + (block.0 + GAP) * Case::ALL.len() as f64 + 16.0;
    let height = TOP + (block.1 + GAP) * Method::WITH_PROXIES.len() as f64 + 30.0;
    let mut figure = Figure::new(width as u32, height as u32)?;
    let title = "Stability: what becomes of a tool at rest within 0.2 mm of its converged solution, or not";
    figure.text((16.0, 22.0), title, 18.0, INK, Anchor::Left);
    let inside = "inside a block: stiffness x1, 10, 100, 1000 to the right; mass x1, 1/10, 1/100, in each dt 0.5, 1, 2, 5, 10 ms, downwards";
    figure.text((16.0, 46.0), inside, 12.5, INK, Anchor::Left);
    let mut at = LEFT;
    for (_, colour, name) in COLOURS {
        area(&mut figure, Rect { x: at, y: 62.0, width: 14.0, height: 10.0 }, colour);
        figure.text((at + 20.0, 67.0), name, 12.5, INK, Anchor::Left);
        at += 110.0;
    }
    for (row, method) in Method::WITH_PROXIES.into_iter().enumerate() {
        let y = TOP + row as f64 * (block.1 + GAP);
        figure.text((LEFT - 10.0, y + 0.5 * block.1), &method.name(), 13.0, INK, Anchor::Right);
        for (column, case) in Case::ALL.into_iter().enumerate() {
            let x = LEFT + column as f64 * (block.0 + GAP);
            if row == 0 {
                figure.text((x + 0.5 * block.0, TOP - 10.0), case.key(), 10.5, INK, Anchor::Centre);
            }
            let place = Rect { x, y, width: block.0, height: block.1 };
            area(&mut figure, place, NONE);
            for cell in cells.iter().filter(|cell| cell.method == method && cell.case == case) {
                draw_cell(&mut figure, place, cell);
            }
        }
    }
    Ok(figure)
}

/// Draws a cell in its block.
fn draw_cell(figure: &mut Figure, block: Rect, cell: &Cell) {
    let index = |all: &[f64], value: f64| all.iter().position(|own| *own == value).unwrap_or(0);
    let column = index(&STIFFNESS, cell.stiffness) as f64;
    let row = (index(&MASS, cell.mass) * DT_MS.len() + index(&DT_MS, cell.dt_ms)) as f64;
    let colour =
        COLOURS.iter().find(|(verdict, ..)| *verdict == cell.verdict).map_or(NONE, |(_, colour, _)| *colour);
    // A thin white gap between the masses.
    let height = if (row as usize + 1).is_multiple_of(DT_MS.len()) { SIZE.1 - 1.0 } else { SIZE.1 };
    let (x, y) = (block.x + column * SIZE.0, block.y + row * SIZE.1);
    area(figure, Rect { x, y, width: SIZE.0 - 1.0, height }, colour);
}

fn area(figure: &mut Figure, place: Rect, fill: RGBColor) {
    let Rect { x, y, width, height } = place;
    let corners = vec![(x, y), (x + width, y), (x + width, y + height), (x, y + height)];
    figure.add(Shape::Area { corners, fill });
}
