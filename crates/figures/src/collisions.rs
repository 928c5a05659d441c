//! Checks that a figure is readable: no overlapping texts.

use super::panel::Rect;
use super::shapes::{Anchor, Figure, Shape, WIDTH, text_width};

impl Figure {
    /// Returns texts that overlap another or extend beyond the figure, each with the other text; empty for a
    /// readable figure.
    pub fn collisions(&self) -> Vec<(String, String)> {
        let texts: Vec<(&str, Rect)> = self.shapes().iter().filter_map(text_box).collect();
        let page = Rect { x: 0.0, y: 0.0, width: WIDTH, height: self.height() };
        let mut found = Vec::new();
        for (index, (text, place)) in texts.iter().enumerate() {
            if place.width > page.width || !page.holds(*place) {
                found.push(((*text).to_owned(), "the figure's edge".to_owned()));
            }
            let others = texts[..index].iter().filter(|(_, other)| other.overlaps(*place));
            found.extend(others.map(|(other, _)| ((*text).to_owned(), (*other).to_owned())));
        }
        found
    }
}

/// Returns a text and the approximate area of its letters, two thirds of the font's height.
fn text_box(shape: &Shape) -> Option<(&str, Rect)> {
    let Shape::Text { at: (x, y), text, size, anchor, upwards, .. } = shape else { return None };
    let (along, across) = (text_width(text, *size), 0.66 * size.units());
    let before = match anchor {
        Anchor::Left => 0.0,
        Anchor::Centre => 0.5 * along,
        Anchor::Right => along,
    };
    Some((
        text.as_str(),
        if *upwards {
            Rect { x: x - 0.5 * across, y: y - along + before, width: across, height: along }
        } else {
            Rect { x: x - before, y: y - 0.5 * across, width: along, height: across }
        },
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::panel::INK;
    use crate::shapes::TextSize;

    #[test]
    fn texts_that_lie_over_others_or_reach_out_are_found() {
        let mut figure = Figure::new(100.0).unwrap();
        figure.text((10.0, 20.0), "first", TextSize::Label, INK, Anchor::Left);
        figure.text((10.0, 40.0), "below", TextSize::Label, INK, Anchor::Left);
        assert_eq!(figure.collisions(), []);
        figure.text((30.0, 24.0), "over it", TextSize::Label, INK, Anchor::Centre);
        figure.text((WIDTH - 5.0, 60.0), "outside", TextSize::Label, INK, Anchor::Left);
        let found = figure.collisions();
        assert_eq!(found.len(), 2, "{found:?}");
        assert_eq!(found[0], ("over it".to_owned(), "first".to_owned()));
        assert_eq!(found[1].0, "outside");
    }
}
