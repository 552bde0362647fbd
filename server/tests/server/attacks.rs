//! Bodies and headers made to hurt: nested, doubled, packed, out of range, in no encoding.

use ::http::Method;
use bytes::Bytes;
use serde_json::{Value, json};
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::TcpStream,
};
use tonic::Code;

use crate::{
    grpc::raw_call,
    missions,
    support::{Answer, Server, detail, server},
};

const JSON: (&str, &str) = ("content-type", "application/json");
const STEP: &str = "/vbar.v1.GuidanceService/Step";

async fn post(server: &Server, body: impl Into<Bytes>) -> Answer {
    server.http(Method::POST, "/v1/step", &[JSON], body.into()).await
}

/// Refused as malformed; the message has `part` and says where.
async fn malformed(server: &Server, what: &str, body: impl Into<Bytes>, part: &str) {
    let answer = post(server, body).await;
    let error = answer.json();
    assert_eq!(answer.status, 400, "{what}: {error}");
    let reason = &detail(&error, "ErrorInfo").expect("a reason")["reason"];
    assert_eq!(reason, "MALFORMED_JSON", "{what}: {error}");
    let message = error["message"].as_str().expect("a text");
    assert!(message.contains(part) && message.contains("column"), "{what}: {message}");
    assert!(message.len() < 1000, "{what}: {} letters", message.len());
}

/// A first step of the double integrator.
fn good() -> Value {
    json!({
        "problem": missions::double_integrator(),
        "measurement": { "linear": { "components": [20.0, 0.0] } },
    })
}

#[tokio::test(flavor = "multi_thread")]
async fn json_nested_without_end_is_refused() {
    let server = server().await;
    const DEPTH: usize = 1_000_000;
    for (what, open) in [
        (
            "lists where a number belongs",
            r#"{"measurement":{"elapsedS":"#.to_owned() + &"[".repeat(DEPTH),
        ),
        (
            "lists where a list belongs",
            r#"{"measurement":{"linear":{"components":"#.to_owned() + &"[".repeat(DEPTH),
        ),
        ("objects that nobody knows", r#"{"a":"#.repeat(DEPTH / 4)),
        ("objects that are known", r#"{"problem":"#.repeat(DEPTH / 16)),
        ("lists alone", "[".repeat(DEPTH)),
    ] {
        malformed(&server, what, open, "").await;
    }
    assert_eq!(server.post("/v1/step", &good()).await.status, 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn json_field_given_twice_is_refused() {
    let server = server().await;
    let good = good().to_string();
    for (what, body) in [
        ("the same name", good.replacen('{', r#"{"measurement": {}, "#, 1)),
        (
            "two spellings",
            good.replacen('{', r#"{"omitPrediction": true, "omit_prediction": false, "#, 1),
        ),
        ("the same name, escaped", good.replacen('{', r#"{"m\u0065asurement": {}, "#, 1)),
        (
            "nothing and then something",
            good.replacen('{', r#"{"omitPrediction": null, "omitPrediction": true, "#, 1),
        ),
        ("within", good.replace("\"components\":", "\"components\": [1, 1], \"components\":")),
        ("two arms of a choice", good.replacen('{', r#"{"artifactId": "00", "#, 1)),
    ] {
        assert_ne!(body, good, "{what}");
        malformed(&server, what, body, "").await;
    }
    assert_eq!(post(&server, good).await.status, 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn json_text_that_is_no_unicode_is_refused() {
    let server = server().await;
    let with = |bytes: &[u8]| [br#"{"artifactId": ""#, bytes, br#""}"#].concat();
    for (what, bytes) in [
        ("a lone byte", &b"\xff"[..]),
        ("half a letter", b"\xc3"),
        ("an overlong letter", b"\xc0\xaf"),
        ("half a pair", br"\ud800"),
        ("a pair the wrong way round", br"\udc00\ud800"),
        ("a NUL as it is", b"a\0b"),
    ] {
        malformed(&server, what, with(bytes), "").await;
    }
    // In UTF-16, or with a mark of the order of bytes.
    let text = r#"{"artifactId": "00"}"#;
    let wide: Vec<u8> = text.encode_utf16().flat_map(u16::to_be_bytes).collect();
    malformed(&server, "UTF-16", wide, "").await;
    malformed(&server, "a mark", format!("\u{feff}{text}"), "").await;
    // An escaped NUL is a letter like any other: no id has it.
    let answer = post(&server, with(br"a\u0000b")).await;
    let error = answer.json();
    assert_eq!(answer.status, 400, "{error}");
    assert!(error["message"].as_str().unwrap().contains("artifact_id"), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn json_numbers_out_of_range_are_refused() {
    let server = server().await;
    let good = good().to_string();
    let digits = "9".repeat(100_000);
    for number in ["1e400", "-1e999999999999", &digits, "0x10", "1_000", "+1", "01", "NaN", "--1"] {
        let body = good.replacen("20.0", number, 1);
        malformed(&server, &number[..number.len().min(20)], body, "").await;
    }
    for (horizon, part) in [
        ("2147483648", ""),
        ("-2147483649", ""),
        ("1e10", ""),
        ("1.5", ""),
        ("99999999999999999999999999", ""),
        ("true", ""),
        ("{}", ""),
        ("[1]", ""),
    ] {
        let mut problem = good.clone();
        let (before, after) = problem.split_once("\"horizonMax\":").expect("it has one");
        let after = after.trim_start_matches(|c: char| c.is_ascii_digit());
        problem = format!("{before}\"horizonMax\":{horizon}{after}");
        malformed(&server, horizon, problem, part).await;
    }
    // A number that is nothing but long is a number.
    let long = good.replacen("20.0", &format!("20.{}", "0".repeat(100_000)), 1);
    assert_eq!(post(&server, long).await.status, 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn proto_text_that_is_no_unicode_and_endless_groups_are_refused() {
    let server = server().await;
    // StepRequest.artifact_id = 1.
    let text = raw_call(&server, STEP, &[0x0a, 0x02, 0xc3, 0x28]).await;
    assert_eq!(text.code(), Code::InvalidArgument, "{text}");
    let nul = raw_call(&server, STEP, &[0x0a, 0x01, 0x00]).await;
    assert_eq!(nul.code(), Code::InvalidArgument, "{nul}");
    assert!(nul.message().contains("artifact_id"), "{nul}");
    // Groups within groups, in a field that is known and in one that is not.
    for start in [(4 << 3) | 3, (13 << 3) | 3] {
        let groups = raw_call(&server, STEP, &[start; 1 << 20]).await;
        assert_eq!(groups.code(), Code::InvalidArgument, "{groups}");
    }
    // A length beyond everything.
    let long = [&[0x0a][..], &[0xff; 9], &[0x01]].concat();
    let long = raw_call(&server, STEP, &long).await;
    assert_eq!(long.code(), Code::InvalidArgument, "{long}");
}

#[tokio::test(flavor = "multi_thread")]
async fn compressed_bodies_are_refused_without_being_unpacked() {
    let server = server().await;
    let packed = Bytes::from_static(b"\x1f\x8b\x08\x00");
    for encoding in ["gzip", "deflate", "br", "zstd", "gzip, gzip", "identity, gzip", "x"] {
        let headers = [JSON, ("content-encoding", encoding)];
        for (method, path) in [
            (Method::POST, "/v1/step"),
            (Method::POST, "/v1/precompute"),
            (Method::POST, "/v1/plans"),
            (Method::POST, "/v1/plans:compute"),
            (Method::POST, "/v1/safety:report"),
        ] {
            let answer = server.http(method, path, &headers, packed.clone()).await;
            assert_eq!(answer.status, 415, "{path} took {encoding}");
        }
    }
    // A message whose flag says that it is packed, with and without a word about how.
    for encoding in ["gzip", "zstd", "identity", ""] {
        let mut headers = vec![("content-type", "application/grpc"), ("te", "trailers")];
        if !encoding.is_empty() {
            headers.push(("grpc-encoding", encoding));
        }
        let body = Bytes::from_static(b"\x01\x00\x00\x00\x04\x1f\x8b\x08\x00");
        let answer = server.http(Method::POST, STEP, &headers, body).await;
        let status = &answer.headers["grpc-status"];
        // UNIMPLEMENTED, as gRPC's text on compression says; INTERNAL where nothing was named.
        let named = matches!(encoding, "gzip" | "zstd");
        assert_eq!(status, if named { "12" } else { "13" }, "{encoding:?}: {:?}", answer.headers);
        assert!(!answer.headers.contains_key("grpc-encoding"));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn headers_that_are_no_text_hurt_nobody() {
    let server = server().await;
    let names = ["x-request-id", "traceparent", "authorization", "content-type", "accept", "range"];
    for name in names.into_iter().chain(["grpc-timeout", "request-timeout-ms", "content-encoding"])
    {
        for value in [&b"\xff\xfe"[..], b"\xc3\x28", &b"x".repeat(8000)] {
            let mut stream = TcpStream::connect(server.address).await.unwrap();
            let head = b"GET /v1/info HTTP/1.1\r\nhost: x\r\nconnection: close\r\n";
            let header = [name.as_bytes(), b": ", value, b"\r\n\r\n"].concat();
            stream.write_all(&[&head[..], &header].concat()).await.unwrap();
            let mut answer = Vec::new();
            stream.read_to_end(&mut answer).await.unwrap();
            let status = String::from_utf8_lossy(&answer[..12.min(answer.len())]).into_owned();
            let right = ["HTTP/1.1 200", "HTTP/1.1 400"].contains(&&*status);
            assert!(right, "{name}: {status}");
        }
    }
    // What no header may hold ends the connection, or is refused as no HTTP.
    for header in [&b"x: a\0b"[..], b"x\0y: a", b"x: a\x01b", b": a", b"x y: a", b"\xff: a"] {
        let mut stream = TcpStream::connect(server.address).await.unwrap();
        let head = b"GET /v1/info HTTP/1.1\r\nhost: x\r\nconnection: close\r\n";
        stream.write_all(&[&head[..], header, b"\r\n\r\n"].concat()).await.unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).await.unwrap();
        assert!(answer.is_empty() || answer.starts_with(b"HTTP/1.1 400"), "{header:?}");
    }
    assert_eq!(server.get("/v1/info").await.status, 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn request_whose_end_is_told_twice_is_refused() {
    let server = server().await;
    // Two readers of such a request could see two different ones (RFC 9112, sec. 11.2).
    for lengths in [
        "content-length: 2\r\ncontent-length: 20\r\n",
        "content-length: 2, 20\r\n",
        "content-length: +2\r\n",
        "content-length: -2\r\n",
        "transfer-encoding: chunked, identity\r\n",
        "transfer-encoding: xchunked\r\n",
        "content-length : 2\r\n",
    ] {
        let mut stream = TcpStream::connect(server.address).await.unwrap();
        let request = format!(
            "POST /v1/step HTTP/1.1\r\nhost: x\r\ncontent-type: application/json\r\n{lengths}\r\n{{}}\
             GET /v1/info HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\r\n"
        );
        stream.write_all(request.as_bytes()).await.unwrap();
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer).await;
        let answer = String::from_utf8_lossy(&answer);
        assert!(answer.is_empty() || answer.starts_with("HTTP/1.1 400"), "{lengths}: {answer}");
        assert!(!answer.contains("HTTP/1.1 200"), "{lengths}: {answer}");
    }
}
