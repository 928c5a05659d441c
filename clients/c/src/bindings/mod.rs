//! Declarations for other languages, generated from the messages: the C header and the Python module.

mod c;
mod constants;
mod python;

pub use c::c_header;
pub use python::python_module;

use ipc_types::messages::layout::{Description, Element, fingerprint};
use ipc_types::reference::every_message;

use crate::error::ClientError;
use crate::ffi::{FUNCTIONS, STATUSES, VIEWS};

/// Name of the entry for the library's own functions, structures and statuses.
const ABI: &str = "Abi";

/// Returns the layouts of all messages, and of the C interface itself:
/// `State=729b226247fc0784;Command=…;Abi=…`.
pub fn layouts() -> String {
    let all = every_message();
    let messages = all.iter().map(|message| (message.short_name(), message.layout_hash()));
    let each: Vec<String> =
        messages.chain([(ABI, abi_hash())]).map(|(name, hash)| format!("{name}={hash}")).collect();
    each.join(";")
}

/// Returns a hash of the functions with their types, the structures with their offsets, and the statuses.
fn abi_hash() -> String {
    let mut text = String::new();
    for function in FUNCTIONS {
        text.push_str(&format!("{} {:?} {}\n", function.name, function.arguments, function.returns));
    }
    for view in VIEWS {
        let fields: Vec<_> =
            view.fields.iter().map(|(name, c_type, offset, _)| (name, c_type, offset)).collect();
        text.push_str(&format!("{} {fields:?} {}\n", view.name, view.size));
    }
    let statuses: Vec<_> = STATUSES.iter().map(|(name, value, _)| (name, value)).collect();
    text.push_str(&format!("{statuses:?}"));
    fingerprint(&text)
}

/// Compares the layouts that a program was built with against this library's.
///
/// # Errors
/// [`ClientError::Layout`] with the first message that differs, or with `Abi`.
pub fn check_layouts(given: &str) -> Result<(), ClientError> {
    let all = every_message();
    let differs = |name: &str, layout: &str, ours: String| {
        let (message, given) = (name.to_owned(), layout.to_owned());
        Err(ClientError::Layout { message, given, ours, version: env!("CARGO_PKG_VERSION") })
    };
    let mut abi = "none";
    for pair in given.split(';') {
        let (name, layout) = pair.split_once('=').unwrap_or((pair, "none"));
        if name == ABI {
            abi = layout;
            continue;
        }
        let known = all.iter().find(|message| message.short_name() == name);
        let ours = known.map_or_else(|| "no such message".to_owned(), |message| message.layout_hash());
        if ours != layout {
            return differs(name, layout, ours);
        }
    }
    // A header without this entry also means another version.
    if abi == abi_hash() { Ok(()) } else { differs(ABI, abi, abi_hash()) }
}

/// Returns all messages, each after the messages it contains.
fn nested_first() -> Vec<&'static Description> {
    fn add(message: &'static Description, all: &mut Vec<&'static Description>) {
        if all.iter().any(|known| known.name == message.name) {
            return;
        }
        for field in message.fields {
            if let Element::Message(nested) = field.element {
                add(nested, all);
            }
        }
        all.push(message);
    }
    let mut all = Vec::new();
    every_message().into_iter().for_each(|message| add(message, &mut all));
    all
}

/// Converts `CArmGeometry` to `c_arm_geometry`.
fn snake_case(name: &str) -> String {
    let mut text = String::new();
    for letter in name.chars() {
        if letter.is_ascii_uppercase() && !text.is_empty() {
            text.push('_');
        }
        text.push(letter.to_ascii_lowercase());
    }
    text
}

/// Splits a doc comment into plain lines of at most `width` characters, without rustdoc links.
fn wrapped(doc: &str, width: usize) -> Vec<String> {
    let plain = doc.replace("[`", "`").replace("`]", "`");
    let mut lines = vec![String::new()];
    for word in plain.split_whitespace() {
        let last = lines.last().map_or(0, |line| line.chars().count());
        if last > 0 && last + 1 + word.chars().count() > width {
            lines.push(String::new());
        }
        if let Some(line) = lines.last_mut() {
            if !line.is_empty() {
                line.push(' ');
            }
            line.push_str(word);
        }
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_layout_is_refused_with_the_message_and_both_layouts() {
        assert!(check_layouts(&layouts()).is_ok());
        let state = every_message()[0].layout_hash();
        let changed = layouts().replace(&state, "0123456789abcdef");
        let refusal = check_layouts(&changed).unwrap_err().to_string();
        assert!(["State", "0123456789abcdef", &state].iter().all(|word| refusal.contains(word)), "{refusal}");
        assert!(check_layouts("Nonsense=1").unwrap_err().to_string().contains("no such message"));
        assert!(check_layouts("").is_err(), "empty layouts must be refused");
    }

    /// A program built against other functions or structures must be refused even if all messages match.
    #[test]
    fn another_c_interface_is_refused_though_all_messages_are_the_same() {
        let (messages, abi) =
            layouts().rsplit_once(";Abi=").map(|(m, a)| (m.to_owned(), a.to_owned())).unwrap();
        for given in [messages.clone(), format!("{messages};Abi=0123456789abcdef")] {
            let refusal = check_layouts(&given).unwrap_err().to_string();
            assert!(refusal.contains("Abi") && refusal.contains(&abi), "{refusal}");
        }
    }

    #[test]
    fn names_and_docs_are_rewritten() {
        assert_eq!(snake_case("CArmGeometry"), "c_arm_geometry");
        assert_eq!(wrapped(" See [`State`]\n now", 9), ["See", "`State`", "now"]);
    }
}
