//! Who may use the page: whoever has the only token, which is for everything, or several users, each with a token and a role.

use std::path::Path;

use cara_std::control::Role;
use cara_tools::exit::Ended;

/// Fewest characters of a token: fewer could be found by trying.
const TOKEN_LEAST: usize = 16;
/// Bytes of a name, as in the manager's audit log.
const LONGEST_NAME: usize = 64;

/// Somebody who has a token.
#[derive(Clone, PartialEq, Eq)]
pub(crate) struct User {
    pub(crate) token: String,
    /// None of the only one, who is not told apart from the user that runs the server.
    pub(crate) name: Option<String>,
    pub(crate) role: Role,
}

impl User {
    /// Whoever has the only token.
    pub(crate) fn only(token: String) -> Self {
        Self { token, name: None, role: Role::Reset }
    }
}

/// The users in a file: one token alone, or lines of role, name and token. An error never shows what may be a token.
pub(crate) fn read(path: &Path, text: &str) -> anyhow::Result<Vec<User>> {
    let shown = path.display();
    let only = text.trim();
    if is_token(only) && !only.starts_with('#') {
        return Ok(vec![User::only(only.to_owned())]);
    }
    let none = || {
        Ended::usage(format!(
            "{shown} has no token: one line of at least {TOKEN_LEAST} letters and digits, as of `openssl rand -hex 32`, or \
             for each user a line `ROLE NAME TOKEN`"
        ))
    };
    if only.split_whitespace().count() == 1 {
        return Err(none());
    }
    let mut users: Vec<User> = Vec::new();
    for (line, words) in (1..).zip(text.lines().map(|line| line.split_whitespace().collect::<Vec<_>>())) {
        let wrong = |what: &str| {
            let form = "write `ROLE NAME TOKEN`, as in `see lobby 3f0c…`";
            Ended::usage(format!("{shown}:{line}: {what}: {form}"))
        };
        let user = match words[..] {
            [] => continue,
            [first, ..] if first.starts_with('#') => continue,
            [role, name, token] => {
                let role =
                    Role::named(role).ok_or_else(|| wrong("the role is none of stop, see, operate and reset"))?;
                if !is_token(token) {
                    return Err(wrong(&format!(
                        "the token has fewer than {TOKEN_LEAST} letters and digits, or others"
                    )));
                }
                if name.len() > LONGEST_NAME || name.chars().any(char::is_control) {
                    return Err(wrong(&format!("the name has more than {LONGEST_NAME} bytes, or control characters")));
                }
                User { token: token.to_owned(), name: Some(name.to_owned()), role }
            }
            _ => return Err(wrong("this is no role, name and token")),
        };
        if users.iter().any(|other| other.name == user.name) {
            return Err(wrong("another line has this name"));
        }
        if users.iter().any(|other| other.token == user.token) {
            return Err(wrong("another line has this token"));
        }
        users.push(user);
    }
    if users.is_empty() {
        return Err(none());
    }
    Ok(users)
}

fn is_token(text: &str) -> bool {
    text.len() >= TOKEN_LEAST && text.bytes().all(|byte| byte.is_ascii_graphic())
}

#[cfg(test)]
mod tests {
    use super::*;

    const TOKEN: &str = "0123456789abcdef";

    fn of(text: &str) -> Result<Vec<(Option<String>, Role)>, String> {
        let users = read(Path::new("tokens"), text).map_err(|error| error.to_string())?;
        Ok(users.into_iter().map(|user| (user.name, user.role)).collect())
    }

    #[test]
    fn a_token_alone_is_for_everything_and_a_line_for_its_role() {
        assert_eq!(of(&format!("{TOKEN}\n")), Ok(vec![(None, Role::Reset)]));
        let several = format!(
            "# who may what\nsee lobby {TOKEN}\n\n  stop\tgate  {TOKEN}1\noperate anna {TOKEN}2\nreset bert {TOKEN}3"
        );
        let named = |name: &str, role| (Some(name.to_owned()), role);
        let expected = [
            named("lobby", Role::See),
            named("gate", Role::Stop),
            named("anna", Role::Operate),
            named("bert", Role::Reset),
        ];
        assert_eq!(of(&several), Ok(expected.to_vec()));
    }

    #[test]
    fn a_mistake_is_told_with_its_line_and_without_a_token() {
        for (text, told) in [
            (format!("see a {TOKEN}\nadmin b {TOKEN}1"), "tokens:2: the role is none of"),
            (format!("{TOKEN} see a"), "tokens:1: the role is none of"),
            (format!("see a {TOKEN}\nstop a {TOKEN}1"), "tokens:2: another line has this name"),
            (format!("see a {TOKEN}\nstop b {TOKEN}"), "tokens:2: another line has this token"),
            ("see a short".to_owned(), "tokens:1: the token has fewer than 16"),
            (format!("see a {TOKEN}\n{TOKEN}"), "tokens:2: this is no role, name and token"),
            (format!("see a b {TOKEN}"), "tokens:1: this is no role, name and token"),
            (format!("see {} {TOKEN}", "x".repeat(65)), "tokens:1: the name has more than 64"),
            ("short".to_owned(), "has no token"),
            ("# nobody\n".to_owned(), "has no token"),
            (String::new(), "has no token"),
        ] {
            let mistake = of(&text).unwrap_err();
            assert!(mistake.contains(told) && !mistake.contains(TOKEN), "{text}: {mistake}");
        }
    }
}
