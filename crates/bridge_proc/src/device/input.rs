//! Names of axes and buttons, as linux/input-event-codes.h and `evtest` have them.

use super::event::{EV_ABS, EV_KEY, EV_REL, InputEvent};

/// An axis or a button of a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Input {
    /// An axis that reports where it is, once it changes.
    Absolute(u16),
    /// An axis that reports only while it is deflected, and never that it is back at rest.
    Relative(u16),
    /// A button or key.
    Button(u16),
}

const ABSOLUTE: [(&str, u16); 15] = [
    ("ABS_X", 0x00),
    ("ABS_Y", 0x01),
    ("ABS_Z", 0x02),
    ("ABS_RX", 0x03),
    ("ABS_RY", 0x04),
    ("ABS_RZ", 0x05),
    ("ABS_THROTTLE", 0x06),
    ("ABS_RUDDER", 0x07),
    ("ABS_WHEEL", 0x08),
    ("ABS_GAS", 0x09),
    ("ABS_BRAKE", 0x0a),
    ("ABS_HAT0X", 0x10),
    ("ABS_HAT0Y", 0x11),
    ("ABS_HAT1X", 0x12),
    ("ABS_HAT1Y", 0x13),
];

const RELATIVE: [(&str, u16); 9] = [
    ("REL_X", 0x00),
    ("REL_Y", 0x01),
    ("REL_Z", 0x02),
    ("REL_RX", 0x03),
    ("REL_RY", 0x04),
    ("REL_RZ", 0x05),
    ("REL_HWHEEL", 0x06),
    ("REL_DIAL", 0x07),
    ("REL_WHEEL", 0x08),
];

/// Buttons with names of their own.
const BUTTONS: [(&str, u16); 31] = [
    ("BTN_LEFT", 0x110),
    ("BTN_RIGHT", 0x111),
    ("BTN_MIDDLE", 0x112),
    ("BTN_TRIGGER", 0x120),
    ("BTN_THUMB", 0x121),
    ("BTN_SOUTH", 0x130),
    ("BTN_EAST", 0x131),
    ("BTN_C", 0x132),
    ("BTN_NORTH", 0x133),
    ("BTN_WEST", 0x134),
    ("BTN_Z", 0x135),
    ("BTN_TL", 0x136),
    ("BTN_TR", 0x137),
    ("BTN_TL2", 0x138),
    ("BTN_TR2", 0x139),
    ("BTN_SELECT", 0x13a),
    ("BTN_START", 0x13b),
    ("BTN_MODE", 0x13c),
    ("BTN_THUMBL", 0x13d),
    ("BTN_THUMBR", 0x13e),
    ("BTN_DPAD_UP", 0x220),
    ("BTN_DPAD_DOWN", 0x221),
    ("BTN_DPAD_LEFT", 0x222),
    ("BTN_DPAD_RIGHT", 0x223),
    ("KEY_ESC", 1),
    ("KEY_ENTER", 28),
    ("KEY_SPACE", 57),
    ("KEY_UP", 103),
    ("KEY_PAGEUP", 104),
    ("KEY_DOWN", 108),
    ("KEY_PAGEDOWN", 109),
];

/// Keys whose codes follow each other as on the keyboard: the first code, and the last parts of the names.
const KEY_ROWS: [(u16, &str); 4] = [
    (2, "1 2 3 4 5 6 7 8 9 0"),
    (16, "Q W E R T Y U I O P"),
    (30, "A S D F G H J K L"),
    (44, "Z X C V B N M"),
];
/// Function keys: the code of F1, and their number.
const FUNCTION_KEYS: (u16, u16) = (59, 10);
/// Numbered buttons: the code of `BTN_0`, and their number.
const NUMBERED_BUTTONS: (u16, u16) = (0x100, 10);

/// What a name must be.
pub(crate) const EXPECTED: &str = "ABS_X to ABS_RZ, ABS_HAT0X, REL_X to REL_RZ, BTN_0 to BTN_9, BTN_SOUTH, \
                                   BTN_TL, KEY_A, KEY_F1 and so on; or a type and code that `evtest` prints: \
                                   ABS:40, REL:9, KEY:105";

impl Input {
    /// Returns the input with a name.
    pub(crate) fn named(name: &str) -> Option<Input> {
        if let Some((kind, code)) = name.split_once(':') {
            let code = code_of(code)?;
            return match kind {
                "ABS" => Some(Input::Absolute(code)),
                "REL" => Some(Input::Relative(code)),
                "KEY" => Some(Input::Button(code)),
                _ => None,
            };
        }
        let of =
            |table: &[(&str, u16)]| table.iter().find(|(known, _)| *known == name).map(|(_, code)| *code);
        let absolute = of(&ABSOLUTE).map(Input::Absolute);
        absolute.or_else(|| of(&RELATIVE).map(Input::Relative)).or_else(|| {
            of(&BUTTONS).or_else(|| numbered_button(name)).or_else(|| key(name)).map(Input::Button)
        })
    }

    /// Returns the input that an event is about; `None` for events that are not of an axis or a button.
    pub(crate) fn of(event: &InputEvent) -> Option<Input> {
        match event.kind {
            EV_ABS => Some(Input::Absolute(event.code)),
            EV_REL => Some(Input::Relative(event.code)),
            EV_KEY => Some(Input::Button(event.code)),
            _ => None,
        }
    }
}

/// Reads a code in decimal digits, without a sign or leading zeros.
fn code_of(text: &str) -> Option<u16> {
    text.parse().ok().filter(|code: &u16| code.to_string() == text)
}

fn numbered_button(name: &str) -> Option<u16> {
    let number = code_of(name.strip_prefix("BTN_")?)?;
    let (first, count) = NUMBERED_BUTTONS;
    (number < count).then_some(first + number)
}

fn key(name: &str) -> Option<u16> {
    let key = name.strip_prefix("KEY_")?;
    let (first, count) = FUNCTION_KEYS;
    let function = (1..=count).find(|number| key == format!("F{number}")).map(|number| first + number - 1);
    function.or_else(|| {
        KEY_ROWS.iter().find_map(|(first, row)| {
            let place = row.split(' ').position(|name| name == key)?;
            Some(first + place as u16)
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Codes as linux/input-event-codes.h lists them.
    #[test]
    fn names_have_the_kernels_codes() {
        for (name, input) in [
            ("ABS_RZ", Input::Absolute(5)),
            ("ABS_HAT0Y", Input::Absolute(0x11)),
            ("REL_RX", Input::Relative(3)),
            ("BTN_0", Input::Button(0x100)),
            ("BTN_9", Input::Button(0x109)),
            ("BTN_TL", Input::Button(0x136)),
            ("KEY_1", Input::Button(2)),
            ("KEY_0", Input::Button(11)),
            ("KEY_P", Input::Button(25)),
            ("KEY_A", Input::Button(30)),
            ("KEY_B", Input::Button(48)),
            ("KEY_C", Input::Button(46)),
            ("KEY_M", Input::Button(50)),
            ("KEY_F10", Input::Button(68)),
            ("KEY:105", Input::Button(105)),
            ("ABS:40", Input::Absolute(40)),
            ("REL:9", Input::Relative(9)),
        ] {
            assert_eq!(Input::named(name), Some(input), "{name}");
        }
        for name in [
            "", "ABS", "BTN_10", "BTN_-1", "KEY_", "KEY_F11", "KEY_A S", "abs_x", "BTN_+5", "BTN_05",
            "KEY:-1", "BTN:3",
        ] {
            assert_eq!(Input::named(name), None, "{name}");
        }
    }
}
