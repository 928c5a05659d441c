//! A hub of another version, and more programs than a session supports.

use std::fs;

use ipc_types::messages::State;
use ipc_types::messages::services;
use ipc_types::session::{Session, SessionError};
use trabecula_client::{Client, ClientError, Connection};

use crate::common::program::{LIMIT, Place};
use crate::common::scenes;
use crate::strays::{joined, stopped};

/// Regression: the files of another version were parsed first, and gave a parse error.
#[test]
fn a_hub_of_another_version_is_refused_as_such_whatever_its_files_say() {
    let place = Place::new();
    let run = place.start(&scenes::hold("realtime", 120.0));
    let folder = run.session();
    let mut observer = joined(&run, "");
    // The run's own parts have read the files by now.
    observer.wait_state(LIMIT).unwrap();
    let files = ["session.json", "scene.toml"].map(|name| folder.join(name));
    let texts = files.clone().map(|path| fs::read_to_string(path).unwrap());
    let mut announcement: serde_json::Value = serde_json::from_str(&texts[0]).unwrap();
    announcement["trabecula"] = "0.2.0".into();
    announcement.as_object_mut().unwrap().remove("policy");
    fs::write(&files[0], announcement.to_string()).unwrap();
    fs::write(&files[1], format!("a_key_of_another_version = 1\n{}", texts[1])).unwrap();
    let session = Some(folder.to_str().unwrap().to_owned());
    let refused = Client::connect(&Connection { session, controller: Some(String::new()), limit: LIMIT });
    files.iter().zip(&texts).for_each(|(path, text)| fs::write(path, text).unwrap());
    let error = refused.unwrap_err();
    assert!(matches!(error, ClientError::Session(SessionError::Version { .. })), "{error}");
    let text = error.to_string();
    assert!(text.contains("Trabecula 0.2.0") && text.contains(env!("CARGO_PKG_VERSION")), "{text}");
    stopped(run, observer, ());
}

/// Regression: the ninth program that read the states was rejected with the transport's own message.
#[test]
fn a_session_has_room_for_ten_observers_and_refuses_more_by_name() {
    let place = Place::new();
    let run = place.start(&scenes::hold("realtime", 120.0));
    let mut observer = joined(&run, "");
    observer.wait_state(LIMIT).unwrap();
    let session = Session::join(&run.session()).unwrap();
    let mut readers = Vec::new();
    let error = loop {
        match session.subscriber::<State>(&services::STATE) {
            Ok(reader) => readers.push(reader),
            Err(error) => break error,
        }
    };
    assert!(readers.len() >= 10, "{} more readers", readers.len());
    let text = error.to_string();
    assert!(matches!(error, SessionError::Crowded { .. }), "{text}");
    assert!(text.contains("service `state`: 16 programs already read it"), "{text}");
    drop(readers);
    stopped(run, observer, ());
}
