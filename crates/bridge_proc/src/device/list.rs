//! Finds input devices in sysfs, which needs no permission for the devices themselves.

use std::path::{Path, PathBuf};

use super::DeviceKind;
use super::input::Input;

/// Where the kernel lists its input devices.
pub(crate) const SYSFS: &str = "/sys/class/input";
const NODES: &str = "/dev/input";
/// Maximum length of an attribute: a name has at most 255 bytes, a bitmap fewer than 300.
const ATTRIBUTE_BYTES: u64 = 4096;

/// An input device that could drive a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FoundDevice {
    /// Its name, as the device reports it.
    pub name: String,
    /// Its node.
    pub node: PathBuf,
    /// Its kind, by name, axes and buttons.
    pub kind: DeviceKind,
}

/// Lists the gamepads, six-axis mice and pedals of this machine, by node.
pub fn devices() -> Vec<FoundDevice> {
    devices_in(Path::new(SYSFS))
}

fn devices_in(sysfs: &Path) -> Vec<FoundDevice> {
    let entries = std::fs::read_dir(sysfs).into_iter().flatten().flatten();
    let mut numbers: Vec<u32> =
        entries.filter_map(|entry| entry.file_name().to_str()?.strip_prefix("event")?.parse().ok()).collect();
    numbers.sort_unstable();
    numbers.into_iter().filter_map(|number| device(sysfs, number)).collect()
}

fn device(sysfs: &Path, number: u32) -> Option<FoundDevice> {
    let folder = sysfs.join(format!("event{number}/device"));
    let attribute = |name: &str| -> Option<String> {
        let bytes = ipc_types::text_file::read_bytes(&folder.join(name), ATTRIBUTE_BYTES).ok()?;
        Some(String::from_utf8_lossy(&bytes).trim().to_owned())
    };
    let name = attribute("name")?;
    let map = |kind: &str| attribute(&format!("capabilities/{kind}")).unwrap_or_default();
    let kind = kind_of(&name, &map("key"), &map("abs"), &map("rel"))?;
    Some(FoundDevice { name, node: Path::new(NODES).join(format!("event{number}")), kind })
}

fn kind_of(name: &str, keys: &str, absolute: &str, relative: &str) -> Option<DeviceKind> {
    let name = name.to_lowercase();
    let has = |input: &str| match Input::named(input) {
        Some(Input::Absolute(code)) => has_bit(absolute, code),
        Some(Input::Relative(code)) => has_bit(relative, code),
        Some(Input::Button(code)) => has_bit(keys, code),
        None => false,
    };
    let has_six =
        |kind: &str| ["X", "Y", "Z", "RX", "RY", "RZ"].iter().all(|axis| has(&format!("{kind}_{axis}")));
    if has("BTN_SOUTH") && has("ABS_X") {
        return Some(DeviceKind::Gamepad);
    }
    if has("BTN_0") && (has_six("ABS") || has_six("REL")) {
        return Some(DeviceKind::SpaceMouse);
    }
    let is_pedal = name.contains("pedal") || name.contains("foot");
    (is_pedal && has("KEY_A")).then_some(DeviceKind::Pedal)
}

/// Returns whether a bitmap has a bit: hexadecimal words of 64 bits, the highest first.
fn has_bit(map: &str, bit: u16) -> bool {
    let word = map.split_whitespace().rev().nth(usize::from(bit / 64));
    word.and_then(|word| u64::from_str_radix(word, 16).ok()).is_some_and(|word| word >> (bit % 64) & 1 == 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bitmaps as a kernel lists them, and junk.
    #[test]
    fn devices_are_known_by_their_axes_and_buttons() {
        let sysfs = tempfile::tempdir().unwrap();
        let add = |number: u32, name: &str, keys: &str, absolute: &str, relative: &str| {
            let folder = sysfs.path().join(format!("event{number}/device/capabilities"));
            std::fs::create_dir_all(&folder).unwrap();
            std::fs::write(folder.join("../name"), format!("{name}\n")).unwrap();
            for (map, text) in [("key", keys), ("abs", absolute), ("rel", relative)] {
                std::fs::write(folder.join(map), format!("{text}\n")).unwrap();
            }
        };
        add(12, "Microsoft X-Box 360 pad", "7cdb000000000000 0 0 0 0", "3003f", "0");
        add(3, "3Dconnexion SpaceNavigator", "3 0 0 0 0", "3f", "0");
        add(4, "3Dconnexion SpaceMouse Compact", "3 0 0 0 0", "0", "3f");
        add(
            5,
            "PCsensor FootSwitch Keyboard",
            "1000000000007 ff800000000007ff febeffdfffefffff fffffffffffffffe",
            "0",
            "0",
        );
        add(
            6,
            "AT Translated Set 2 keyboard",
            "402000000 3803078f800d001 feffffdfffefffff fffffffffffffffe",
            "0",
            "0",
        );
        add(7, "junk", "zz \u{fffd} -1", "18446744073709551616", "");
        std::fs::create_dir(sysfs.path().join("mouse0")).unwrap();
        let found: Vec<(PathBuf, DeviceKind)> =
            devices_in(sysfs.path()).into_iter().map(|device| (device.node, device.kind)).collect();
        let node = |number: u32| PathBuf::from(format!("/dev/input/event{number}"));
        assert_eq!(
            found,
            [
                (node(3), DeviceKind::SpaceMouse),
                (node(4), DeviceKind::SpaceMouse),
                (node(5), DeviceKind::Pedal),
                (node(12), DeviceKind::Gamepad)
            ]
        );
        assert!(devices_in(&sysfs.path().join("absent")).is_empty());
    }
}
