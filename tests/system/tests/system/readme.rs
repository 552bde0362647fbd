//! What README.md shows works as it is printed.

use std::{
    io::{Read as _, Write as _},
    net::TcpStream,
    path::Path,
};

use vbar_server::Config;

use crate::nodes::Mortal;

fn text(path: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(path);
    std::fs::read_to_string(&path).unwrap_or_else(|fault| panic!("{}: {fault}", path.display()))
}

/// The text of every fenced block of a language.
fn blocks(language: &str) -> Vec<String> {
    let fence = format!("```{language}\n");
    let readme = text("README.md");
    let parts = readme.split(&fence).skip(1);
    parts.map(|part| part.split("\n```").next().unwrap().to_owned()).collect()
}

#[test]
fn curl_of_the_readme_gets_the_answer_it_shows() {
    let command = blocks("sh").into_iter().find(|b| b.starts_with("curl ")).expect("a curl");
    let url = command.split_whitespace().find(|word| word.starts_with("http://")).unwrap();
    let (_, path) = url.trim_start_matches("http://").split_once('/').unwrap();
    let body = command.split("-d '").nth(1).unwrap().split('\'').next().unwrap();

    let node = Mortal::start(Config::default());
    let answer = post(node.url.trim_start_matches("http://"), path, body);
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    let answer: serde_json::Value =
        serde_json::from_str(answer.split("\r\n\r\n").nth(1).unwrap()).unwrap();
    let shown: serde_json::Value = serde_json::from_str(&blocks("json")[0]).unwrap();
    for (field, value) in shown.as_object().unwrap() {
        assert_eq!(&answer[field], value, "{field}");
    }
}

#[test]
fn client_call_of_the_readme_is_the_one_that_is_tested() {
    let call = &blocks("rust")[0];
    let example = text("client/examples/step.rs");
    assert!(example.contains(call), "client/examples/step.rs does not contain:\n{call}");
}

#[test]
fn pictures_of_the_readme_exist() {
    let readme = text("README.md");
    let shown: Vec<&str> = readme
        .split("](")
        .skip(1)
        .map(|rest| rest.split(')').next().unwrap())
        .filter(|target| !target.contains("://"))
        .collect();
    assert!(shown.iter().any(|target| target.ends_with(".svg")), "no picture in {shown:?}");
    for target in shown {
        let path = target.split('#').next().unwrap();
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(path);
        assert!(path.exists(), "{target} does not exist");
    }
}

/// HTTP/1.1 by hand, since `curl` may not be on the machine that runs the tests.
fn post(address: &str, path: &str, body: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    write!(
        stream,
        "POST /{path} HTTP/1.1\r\nHost: {address}\r\nContent-Type: application/json\r\n\
         Content-Length: {}\r\nConnection: close\r\n\r\n{body}",
        body.len()
    )
    .unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}
