//! Tokens and certificates, as operators use them.

use std::{
    fs,
    io::{BufRead as _, BufReader, Read as _, Write as _},
    net::TcpStream,
    path::Path,
    process::Stdio,
};

use rcgen::{CertificateParams, KeyPair};
use vbar_client::{Client, Credentials, Options};

use crate::{mission, output, text, vbar};

/// A token with its entry in `tokens.toml` of the folder.
fn draw_token(folder: &Path, name: &str, roles: &[&str]) -> String {
    let mut arguments = vec!["token", "new", "--name", name];
    arguments.extend(roles.iter().flat_map(|role| ["--role", role]));
    let made = output(&arguments);
    assert!(made.status.success());
    let path = folder.join("tokens.toml");
    let before = fs::read_to_string(&path).unwrap_or_default();
    fs::write(path, before + &text(&made.stderr)).unwrap();
    text(&made.stdout).trim().to_owned()
}

/// A node that logs everything, killed at the end, and what it has logged by then.
fn served(arguments: &[&str], calls: impl FnOnce(&str)) -> String {
    let mut command = vbar(&["serve", "--listen", "127.0.0.1:0", "--log", "trace"]);
    let mut child =
        command.args(arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    // Read from the start, or the node would wait for room in the pipe.
    let mut log = child.stderr.take().unwrap();
    let log = std::thread::spawn(move || {
        let mut text = Vec::new();
        log.read_to_end(&mut text).unwrap();
        String::from_utf8(text).unwrap()
    });
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    let url = line.trim().strip_prefix("listening on ").expect(&line).to_owned();
    calls(&url);
    child.kill().unwrap();
    child.wait().unwrap();
    log.join().unwrap()
}

#[test]
fn token_is_in_no_log_however_it_is_sent() {
    let folder = tempfile::tempdir().unwrap();
    let token = draw_token(folder.path(), "ground", &["step"]);
    assert!(token.starts_with("vbar_"), "{token}");
    let config = folder.path().join("node.toml");
    let tokens_file = folder.path().join("tokens.toml");
    let audit_file = folder.path().join("audit.jsonl");
    let settings = format!("tokens_file = {tokens_file:?}\naudit_file = {audit_file:?}\n");
    fs::write(&config, settings).unwrap();
    let log = served(&["--config", config.to_str().unwrap()], |url| {
        let address = url.strip_prefix("http://").unwrap();
        let mut statuses = Vec::new();
        for (path, header, body) in [
            ("/v1/info", format!("Authorization: Bearer {token}"), ""),
            ("/v1/info", format!("Authorization: Basic {token}"), ""),
            ("/v1/info", format!("Authorization: {token}"), ""),
            ("/v1/info", format!("Cookie: token={token}"), ""),
            ("/v1/info", format!("X-Request-Id: {token}"), ""),
            ("/v1/info", format!("X-Token: {token}"), ""),
            (&format!("/v1/info?access_token={token}"), "X: y".to_owned(), ""),
            (&format!("/v1/plans/{token}"), format!("Authorization: Bearer {token}"), ""),
            (&format!("/{token}"), format!("Authorization: Bearer {token}"), ""),
            ("/v1/step", format!("Authorization: Bearer {token}"), &format!("{{\"{token}\": 1}}")),
            (
                "/v1/step",
                format!("Authorization: Bearer {token}"),
                &format!("{{\"artifactId\": \"{token}\"}}"),
            ),
        ] {
            let mut stream = TcpStream::connect(address).unwrap();
            write!(
                stream,
                "POST {path} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n{header}\r\n\
                 Content-Type: application/json\r\nContent-Length: {}\r\n\r\n{body}",
                body.len()
            )
            .unwrap();
            let mut answer = String::new();
            stream.read_to_string(&mut answer).unwrap();
            statuses.push(answer.split(' ').nth(1).unwrap().to_owned());
        }
        let expected =
            ["405", "401", "401", "401", "401", "401", "401", "403", "404", "400", "400"];
        assert_eq!(statuses, expected);
        let credentials = Credentials { token: Some(token.clone()), ..Credentials::default() };
        let options = Options { credentials, ..Options::default() };
        let runtime = tokio::runtime::Runtime::new().unwrap();
        runtime.block_on(async {
            let client = Client::connect(url, options).await.unwrap();
            client.server_info().await.unwrap();
        });
    });
    let secret = token.strip_prefix("vbar_").unwrap();
    let audit = fs::read_to_string(&audit_file).unwrap();
    assert!(log.contains("TRACE") && log.contains("vbar::audit"), "the log is not what it seems");
    assert!(audit.contains("\"caller\":\"ground\""), "{audit}");
    for (what, text) in [("log", log), ("audit file", audit)] {
        let line = text.lines().find(|line| line.contains(secret));
        assert!(line.is_none(), "the {what} has the token: {line:?}");
    }
}

#[test]
fn commands_reach_a_node_that_asks_who_calls() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let names = vec!["localhost".to_owned(), "127.0.0.1".to_owned()];
    let key = KeyPair::generate().unwrap();
    let certificate = CertificateParams::new(names).unwrap().self_signed(&key).unwrap();
    fs::write(path("node.pem"), certificate.pem()).unwrap();
    fs::write(path("node.key"), key.serialize_pem()).unwrap();
    let token = draw_token(folder.path(), "ground", &["plan"]);
    fs::write(path("token"), token + "\n").unwrap();
    fs::write(path("wrong"), "vbar_wrong\n").unwrap();
    let settings = format!(
        "tls_certificate = {:?}\ntls_key = {:?}\ntokens_file = {:?}\n",
        path("node.pem"),
        path("node.key"),
        path("tokens.toml")
    );
    fs::write(path("node.toml"), settings).unwrap();
    let checked = output(&["serve", "--config", &path("node.toml"), "--check-config"]);
    assert!(checked.status.success(), "{}", text(&checked.stderr));

    served(&["--config", &path("node.toml")], |url| {
        assert!(url.starts_with("https://"), "{url}");
        let ca = path("node.pem");
        let near = ["--server", url, "--tls-ca", &ca];
        let ask = |arguments: &[&str], token: Option<&str>| {
            let token = token.map(&path);
            let mut all = [arguments, &near[..]].concat();
            all.extend(token.iter().flat_map(|file| ["--token-file", file.as_str()]));
            output(&all)
        };
        let said = ask(&["health"], None);
        assert!(said.status.success(), "{}", text(&said.stderr));
        let mission = mission("envisat.json");
        let plan = ["plan", &mission];
        let said = ask(&plan, Some("token"));
        assert!(said.status.success(), "{}", text(&said.stderr));
        for (arguments, token, expected) in [
            (&plan[..], None, "Unauthenticated"),
            (&plan[..], Some("wrong"), "Unauthenticated"),
            (&["precompute", &mission][..], Some("token"), "needs the role precompute"),
        ] {
            let refused = ask(arguments, token);
            assert_eq!(refused.status.code(), Some(65), "{arguments:?}");
            assert!(text(&refused.stderr).contains(expected), "{}", text(&refused.stderr));
        }
        // By the environment, as a container's health check gets it.
        let mut command = vbar(&["health"]);
        command.env("VBAR_SERVER", url).env("VBAR_CLIENT_TLS_CA", &ca);
        assert!(command.output().unwrap().status.success());
        let blind = output(&["health", "--server", url]);
        assert!(text(&blind.stderr).contains("tls_ca"), "{}", text(&blind.stderr));
    });

    fs::write(path("tokens.toml"), "[[token]]\nname = 'x'\n").unwrap();
    fs::write(path("node.key"), "nothing").unwrap();
    let checked = output(&["serve", "--config", &path("node.toml"), "--check-config"]);
    assert_eq!(checked.status.code(), Some(64));
    let faults = text(&checked.stderr);
    assert!(faults.contains("tls_key") && faults.contains("tokens_file"), "{faults}");
}

#[test]
fn token_new_names_every_fault_of_its_arguments() {
    let refused =
        output(&["token", "new", "--name", "two words", "--role", "root", "--expires", "soon"]);
    assert_eq!(refused.status.code(), Some(64));
    let faults = text(&refused.stderr);
    for named in ["name", "role", "expires"] {
        assert!(faults.contains(&format!("{named}: expected")), "{faults}");
    }
    assert_eq!(text(&refused.stdout), "");
}
