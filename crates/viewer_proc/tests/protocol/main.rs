//! Tests the server with an independent WebSocket client: the protocol, and the replies to hostile clients.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test")]

mod running;

use std::sync::atomic::Ordering;
use std::time::Duration;

use delivery::viewer::Limits;
use futures_util::{SinkExt, StreamExt};
use ipc_types::messages::State;
use ipc_types::messages::layout::{CDR_LITTLE_ENDIAN, Message as _};
use run_log::{RUN_TOPICS, Topic, schema_of};
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpSocket;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::{Error, Message};
use viewer_proc::ServerOptions;
use viewer_proc::channels::{INFO, NOTICE, SURFACE};
use viewer_proc::server::{ListeningPort, MAX_CLIENTS};
use viewer_proc::services::{Action, Reply, Request, SLICE};
use viewer_proc::slice::{ENCODING, MOST_UNDER_WAY};
use zerocopy::IntoBytes;

use running::{
    Running, call_bytes, channel, close_code, http, next_data, next_response, next_text, options, say,
    subscribe, with, with_server,
};

#[test]
fn channels_have_the_logs_topics_and_schemas_and_deliver_their_messages() {
    with_server(async |running| {
        let (mut socket, channels) = running.client().await;
        for topic in RUN_TOPICS.into_iter().filter(|topic| *topic != Topic::Keyframe) {
            let (name, schema) = schema_of(topic.description());
            let channel = channel(&channels, topic.name());
            assert_eq!(channel["schema"], schema, "{topic}");
            assert_eq!(
                (&channel["schemaName"], &channel["encoding"], &channel["schemaEncoding"]),
                (&json!(name), &json!("cdr"), &json!("ros2msg"))
            );
        }
        let state = State { tick: 42, ..State::zeroed() };
        subscribe(&mut socket, 7, channel(&channels, Topic::State.name())).await;
        running.states_are_wanted(true).await;
        running.board.publish_cdr(Topic::State.name(), 42_000_000, &[state.as_bytes()]);
        let (subscription, time_ns, payload) = next_data(&mut socket).await;
        assert_eq!((subscription, time_ns), (7, 42_000_000));
        assert_eq!(payload, [CDR_LITTLE_ENDIAN.as_slice(), state.as_bytes()].concat());
        assert_eq!(payload.len(), 4 + State::DESCRIPTION.size);

        // A client that subscribes later gets the newest message; for the surface, every block.
        running.board.publish_json(INFO, &json!({"kind": "live"}));
        (0..3).for_each(|block| running.board.publish(SURFACE, 0, block, vec![block as u8]));
        let (mut late, channels) = running.client().await;
        subscribe(&mut late, 1, channel(&channels, INFO)).await;
        assert_eq!(next_data(&mut late).await.2, b"{\"kind\":\"live\"}");
        subscribe(&mut late, 2, channel(&channels, SURFACE)).await;
        for block in 0..3 {
            assert_eq!(next_data(&mut late).await.2, [block]);
        }

        // Only the newest notices are kept.
        (0..70).for_each(|number| running.board.notice("info", &format!("notice {number}")));
        subscribe(&mut late, 3, channel(&channels, NOTICE)).await;
        for number in 6..70 {
            let told: Value = serde_json::from_slice(&next_data(&mut late).await.2).unwrap();
            assert_eq!(told["text"], format!("notice {number}"));
        }

        say(&mut socket, json!({"op": "unsubscribe", "subscriptionIds": [7]})).await;
        running.states_are_wanted(false).await;
    });
}

#[test]
fn only_a_client_with_the_token_commands() {
    with_server(async |running| {
        let (mut socket, _) = running.client().await;
        for token in [json!(null), json!(""), json!("0".repeat(32))] {
            socket.send(call_bytes(1, 5, &json!({"token": token, "action": "stop"}))).await.unwrap();
            let (call, response) = next_response(&mut socket).await;
            assert_eq!((call, &response["ok"]), (5, &json!(false)));
            assert!(response["error"].as_str().unwrap().contains("token"), "{response}");
        }
        assert!(running.called.try_recv().is_err(), "nothing was commanded");

        socket
            .send(call_bytes(1, 6, &json!({"token": running.token, "action": "step", "ticks": 3})))
            .await
            .unwrap();
        let call = running.next_call().await;
        let Request::Control(control) = &call.request else { panic!("{call:?}") };
        assert_eq!((control.action, control.ticks), (Action::Step, Some(3)));
        call.answer.send(Err("pause first".to_owned())).unwrap();
        assert_eq!(next_response(&mut socket).await, (6, json!({"ok": false, "error": "pause first"})));

        for (service, body) in
            [(1, json!({"token": running.token, "action": "fly"})), (9, json!({"token": running.token}))]
        {
            socket.send(call_bytes(service, 7, &body)).await.unwrap();
            assert_eq!(next_response(&mut socket).await.1["ok"], false);
        }
    });
}

/// Any user of the machine can reach the port; states, scene and bone must not be served to them.
#[test]
fn nothing_is_served_to_a_client_without_the_token() {
    with_server(async |running| {
        running.board.publish_json(INFO, &json!({"kind": "live"}));
        let wrong = [String::new(), "?token=".to_owned(), format!("?token={}", "0".repeat(32))];
        let cut = format!("?token={}", &running.token[..31]);
        for query in wrong.iter().chain([&cut]) {
            let mut socket = running.open_with(query, "foxglove.sdk.v1", None).await.unwrap();
            let _ = socket
                .send(Message::text(
                    json!({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 1}]}).to_string(),
                ))
                .await;
            let first = socket.next().await.unwrap().unwrap();
            let Message::Close(Some(frame)) = first else { panic!("{query}: {first:?}") };
            assert_eq!(frame.code, CloseCode::Policy, "{query}");
            assert!(frame.reason.contains("token") && frame.reason.contains("printed"), "{}", frame.reason);
        }
        // The page itself contains nothing of the run.
        let page = http(&running, &format!("GET / HTTP/1.1\r\nHost: {}\r\n\r\n", running.address)).await;
        assert!(page.starts_with("HTTP/1.1 200 OK") && !page.contains(&running.token));
        running.client().await;
    });
    // If so configured, a client without the token can watch but not control.
    with(Running::start(true), async |running| {
        let mut socket = running.open_with("", "foxglove.sdk.v1", None).await.unwrap();
        assert_eq!(next_text(&mut socket).await["op"], "serverInfo");
        socket.send(call_bytes(1, 5, &json!({"action": "stop"}))).await.unwrap();
        assert_eq!(next_response(&mut socket).await.1["ok"], false);
        assert!(running.called.try_recv().is_err(), "nothing was commanded");
    });
}

#[test]
fn no_other_origin_connects() {
    with_server(async |running| {
        let own = format!("http://{}", running.address);
        for origin in [own.as_str(), "http://studio.example"] {
            running.open("foxglove.websocket.v1", Some(origin)).await.unwrap();
        }
        for origin in ["http://evil.example", "null", "http://127.0.0.1:1"] {
            let refused = running.open("foxglove.websocket.v1", Some(origin)).await;
            let Err(Error::Http(response)) = refused else { panic!("{origin}: {refused:?}") };
            assert_eq!(response.status(), 403, "{origin}");
        }
        let Err(Error::Http(response)) = running.open("mqtt", None).await else {
            panic!("an unsupported subprotocol was accepted")
        };
        assert_eq!(response.status(), 400);
    });
}

#[test]
fn the_page_is_served_and_nothing_else() {
    with_server(async |running| {
        let host = running.address;
        let get = |path: &str| format!("GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n");
        let page = http(&running, &get("/")).await;
        assert!(page.starts_with("HTTP/1.1 200 OK\r\n") && page.contains("<!doctype html>"), "{page}");
        assert!(page.contains("Content-Security-Policy: default-src 'self';"));
        for path in ["/../Cargo.toml", "/assets/../../Cargo.toml", "/nothing", "/assets/"] {
            assert!(http(&running, &get(path)).await.starts_with("HTTP/1.1 404"), "{path}");
        }
        let post = format!("POST / HTTP/1.1\r\nHost: {host}\r\n\r\n");
        assert!(http(&running, &post).await.starts_with("HTTP/1.1 404"));
        for rebound in ["evil.example".to_owned(), format!("{host}.evil.example"), "127.0.0.1:1".to_owned()] {
            let get = format!("GET / HTTP/1.1\r\nHost: {rebound}\r\n\r\n");
            assert!(http(&running, &get).await.starts_with("HTTP/1.1 403"), "{rebound}");
        }
        let twice = format!("GET / HTTP/1.1\r\nHost: {host}\r\nHost: evil.example\r\n\r\n");
        assert!(http(&running, &twice).await.starts_with("HTTP/1.1 400"));
        assert!(http(&running, "\0\u{1}garbage\r\n\r\n").await.starts_with("HTTP/1.1 400"));
        let long = format!("GET / HTTP/1.1\r\nHost: {}\r\n", "x".repeat(20_000));
        assert!(http(&running, &long).await.starts_with("HTTP/1.1 431"));
        assert!(http(&running, &get("/ws")).await.starts_with("HTTP/1.1 426"));
    });
}

/// Idle connections must not use up the server's connections and lock the page out.
#[test]
fn idle_connections_keep_nobody_from_the_page() {
    with_server(async |running| {
        let get = format!("GET / HTTP/1.1\r\nHost: {}\r\n\r\n", running.address);
        // A slow client at another address.
        let slow = TcpSocket::new_v4().unwrap();
        slow.bind("127.0.0.2:0".parse().unwrap()).unwrap();
        let mut slow = slow.connect(running.address).await.unwrap();
        slow.write_all(&get.as_bytes()[..10]).await.unwrap();
        let (mut client, channels) = running.client().await;
        let mut idle = Vec::new();
        for _ in 0..3 {
            for _ in 0..100 {
                idle.push(running.tcp().await);
            }
            assert!(http(&running, &get).await.starts_with("HTTP/1.1 200 OK"));
            running.client().await;
        }
        slow.write_all(&get.as_bytes()[10..]).await.unwrap();
        let mut answer = String::new();
        slow.read_to_string(&mut answer).await.unwrap();
        assert!(answer.starts_with("HTTP/1.1 200 OK"), "{answer}");
        // The client with the token stays connected.
        subscribe(&mut client, 1, channel(&channels, INFO)).await;
        running.board.publish_json(INFO, &json!({"kind": "live"}));
        assert_eq!(next_data(&mut client).await.2, b"{\"kind\":\"live\"}");
    });
}

#[test]
fn more_clients_than_are_served_are_told() {
    with_server(async |running| {
        let mut clients = Vec::new();
        for _ in 0..MAX_CLIENTS {
            clients.push(running.client().await);
        }
        let refused = running.open("foxglove.sdk.v1", None).await;
        let Err(Error::Http(response)) = refused else { panic!("{refused:?}") };
        assert_eq!(response.status(), 503);
        drop(clients.pop());
        while running.open("foxglove.sdk.v1", None).await.is_err() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    });
}

/// Regression: with `--watch-by-anyone` the commands of the owner waited in one queue with the requests of
/// all watchers, and 24 watchers made most of them "busy".
#[test]
fn watchers_take_no_place_from_an_owner() {
    with(Running::start(true), async |running| {
        let mut watchers = Vec::new();
        for number in 0..MAX_CLIENTS as u32 {
            let mut watcher = running.open_with("", "foxglove.sdk.v1", None).await.unwrap();
            watcher.send(call_bytes(SLICE, number, &slice(4))).await.unwrap();
            watchers.push(watcher);
        }
        let (_, response) = next_response(watchers.last_mut().unwrap()).await;
        assert!(response["error"].as_str().unwrap().contains("busy"), "{response}");
        let refused = running.open_with("", "foxglove.sdk.v1", None).await;
        assert!(matches!(refused, Err(Error::Http(response)) if response.status() == 503));

        let (mut owner, _) = running.client().await;
        let pause = json!({"token": running.token, "action": "pause"});
        owner.send(call_bytes(1, 1, &pause)).await.unwrap();
        owner.send(call_bytes(SLICE, 2, &slice(4))).await.unwrap();
        let mut taken = Vec::new();
        while taken.len() < 2 {
            // Requests of watchers may have arrived before the owner's.
            taken.extend(Some(running.next_call().await).filter(|call| call.is_owner));
        }
        assert!(matches!(taken[0].request, Request::Control(_)), "{taken:?}");
        assert!(matches!(taken[1].request, Request::Slice(_)), "{taken:?}");
    });
}

/// Regression: connections without the token that request nothing held their slots for ever.
#[test]
fn a_watcher_that_requests_nothing_is_closed() {
    with(Running::start(true), async |running| {
        let mut silent = running.open_with("", "foxglove.sdk.v1", None).await.unwrap();
        let (mut owner, channels) = running.client().await;
        assert_eq!(close_code(&mut silent).await, CloseCode::Policy);
        // The silent owner stays.
        subscribe(&mut owner, 1, channel(&channels, INFO)).await;
        running.board.publish_json(INFO, &json!({"kind": "live"}));
        assert_eq!(next_data(&mut owner).await.2, b"{\"kind\":\"live\"}");
    });
}

#[test]
fn an_allowed_host_gets_the_page_and_others_do_not() {
    with_server(async |running| {
        let get = |host: &str| format!("GET / HTTP/1.1\r\nHost: {host}\r\n\r\n");
        assert!(http(&running, &get("tunnel.example:9000")).await.starts_with("HTTP/1.1 200"));
        let refused = http(&running, &get("tunnel.example:9001")).await;
        assert!(refused.starts_with("HTTP/1.1 403") && refused.contains("--allow-host"), "{refused}");
    });
}

#[test]
fn hostile_clients_are_told_and_closed_and_others_go_on() {
    with_server(async |running| {
        let (mut good, channels) = running.client().await;
        subscribe(&mut good, 1, channel(&channels, Topic::State.name())).await;

        let (mut oversized, _) = running.client().await;
        // The server closes in the middle of the message.
        let _ = oversized.send(Message::text("x".repeat(70 << 10))).await;
        assert_eq!(close_code(&mut oversized).await, CloseCode::Size);

        let (mut flooding, _) = running.client().await;
        for _ in 0..1100 {
            if flooding.feed(Message::text("{}")).await.is_err() {
                break;
            }
        }
        let _ = flooding.flush().await;
        assert_eq!(close_code(&mut flooding).await, CloseCode::Policy);

        // Malformed messages are answered; the connection stays open.
        let (mut malformed, _) = running.client().await;
        for text in [
            "{",
            "[]",
            "{\"op\":5}",
            "{\"op\":\"subscribe\",\"subscriptions\":[{\"id\":1,\"channelId\":999}]}",
        ] {
            malformed.send(Message::text(text)).await.unwrap();
            assert_eq!(next_text(&mut malformed).await["op"], "status", "{text}");
        }
        for bytes in [&b""[..], b"\x02", b"\x02\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff", b"\x63abc"]
        {
            malformed.send(Message::binary(bytes.to_vec())).await.unwrap();
            assert_eq!(next_text(&mut malformed).await["op"], "status", "{bytes:?}");
        }
        let ids: Vec<Value> = (0..300).map(|id| json!({"id": id, "channelId": 1})).collect();
        say(&mut malformed, json!({"op": "subscribe", "subscriptions": ids})).await;
        let status = next_text(&mut malformed).await;
        assert!(status["message"].as_str().unwrap().contains("256"), "{status}");

        let mut broken = running.tcp().await;
        broken.write_all(b"GET /ws HTTP/1.1\r\nHost: ").await.unwrap();
        drop(broken);

        running.states_are_wanted(true).await;
        running.board.publish_cdr(Topic::State.name(), 1, &[b"still here"]);
        assert!(next_data(&mut good).await.2.ends_with(b"still here"));
    });
}

#[test]
fn a_client_that_never_reads_holds_nobody_up_and_is_told_what_it_lost() {
    with_server(async |running| {
        let (mut lazy, channels) = running.client().await;
        subscribe(&mut lazy, 1, channel(&channels, Topic::State.name())).await;
        running.states_are_wanted(true).await;
        // Much more than its queue and the sockets' buffers hold; publishing never blocks.
        let big = vec![0; 1 << 20];
        let count = 10 * (Limits::default().stream_bytes >> 20) as u64;
        for number in 1..=count {
            running.board.publish_cdr(Topic::State.name(), number, &[&big]);
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        let (mut heard, mut told) = (Vec::new(), false);
        while heard.last() != Some(&count) || !told {
            match lazy.next().await.unwrap().unwrap() {
                Message::Binary(bytes) if bytes[0] == 1 => {
                    heard.push(u64::from_le_bytes(bytes[5..13].try_into().unwrap()));
                }
                Message::Text(text) => told |= text.contains("were dropped"),
                _ => {}
            }
        }
        assert!(heard.is_sorted() && (heard.len() as u64) < count, "{heard:?}");
    });
}

/// Returns the body of a `/slice` request.
fn slice(columns: u64) -> Value {
    json!({"centre_m": [0, 0, 0], "right": [1, 0, 0], "down": [0, 1, 0], "side_m": [0.1, 0.1],
        "columns": columns, "rows": 4})
}

/// A client that requests a thousand slices has only a few in progress; the rest are refused at once, and it
/// stays connected.
#[test]
fn a_client_has_few_slices_under_way_and_the_rest_is_refused() {
    with_server(async |running| {
        let (mut socket, _) = running.client().await;
        for number in 0..900 {
            socket.send(call_bytes(SLICE, number, &slice(512))).await.unwrap();
        }
        for number in MOST_UNDER_WAY as u32..900 {
            let (call, response) = next_response(&mut socket).await;
            assert_eq!(call, number);
            assert!(response["error"].as_str().unwrap().contains("in progress"), "{response}");
        }
        let waiting: Vec<_> = running.called.try_iter().collect();
        assert_eq!(waiting.len(), MOST_UNDER_WAY);
        // Each reply makes room for one request.
        for (number, call) in waiting.into_iter().enumerate() {
            assert!(matches!(call.request, Request::Slice(_)));
            call.reply(Reply::Bytes { encoding: ENCODING, bytes: vec![7, number as u8] });
            let bytes = loop {
                match socket.next().await.unwrap().unwrap() {
                    Message::Binary(bytes) if bytes[0] == 3 => break bytes,
                    _ => {}
                }
            };
            assert!(
                bytes.ends_with(&[b"trabecula.slice".as_slice(), &[7, number as u8]].concat()),
                "{bytes:?}"
            );
        }
        socket.send(call_bytes(SLICE, 1000, &slice(512))).await.unwrap();
        running.next_call().await;
    });
}

#[test]
fn what_is_no_slice_is_refused_and_a_slice_needs_no_token_of_who_may_watch() {
    with_server(async |running| {
        let (mut socket, _) = running.client().await;
        let mut far = slice(4);
        far["centre_m"][1] = json!(1e300);
        for (body, why) in
            [(slice(0), "pixels"), (slice(513), "513"), (far, "slice centre"), (json!([]), "malformed")]
        {
            socket.send(call_bytes(SLICE, 5, &body)).await.unwrap();
            let (_, response) = next_response(&mut socket).await;
            assert!(response["error"].as_str().unwrap().contains(why), "{response}, expected `{why}`");
        }
        socket.send(call_bytes(SLICE, 6, &slice(4))).await.unwrap();
        let call = running.next_call().await;
        call.refuse("there is no CT");
        assert_eq!(next_response(&mut socket).await, (6, json!({"ok": false, "error": "there is no CT"})));
    });
}

#[test]
fn clients_hear_that_the_viewer_ends() {
    with_server(async |running| {
        let (mut socket, _) = running.client().await;
        running.over.store(true, Ordering::Relaxed);
        assert_eq!(close_code(&mut socket).await, CloseCode::Away);
    });
}

#[test]
fn a_port_in_use_is_named() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port();
    let error = ListeningPort::open(&ServerOptions { port, ..options(false) }).unwrap_err();
    assert!(error.is_bad_input());
    let text = error.to_string();
    assert!(text.contains(&format!("127.0.0.1:{port}")) && text.contains("--port"), "{text}");
}
