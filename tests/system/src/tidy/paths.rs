//! Which paths a Rust file uses.

use proc_macro2::{Ident, Span, TokenStream, TokenTree};
use syn::{
    Attribute, File, ItemMod, ItemUse, Macro, Path, UseTree,
    visit::{self, Visit},
};

/// One path as it is used in a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Used {
    /// `crate`, then modules and names, for a path into the same crate; else as written.
    pub(super) segments: Vec<String>,
    /// Where, from 1.
    pub(super) line: usize,
    /// Inside a module that only tests compile.
    pub(super) test: bool,
}

/// Every path that `text`, the file at `path` below a crate's `src`, uses.
///
/// Macro arguments are read as tokens, since their grammar is the macro's own.
pub(super) fn used(path: &str, text: &str) -> Result<Vec<Used>, String> {
    let file: File = syn::parse_file(text)
        .map_err(|fault| format!("{path}:{}: {fault}", fault.span().start().line))?;
    let mut collector = Collector { modules: modules_of(path), test: false, found: Vec::new() };
    collector.visit_file(&file);
    Ok(collector.found)
}

/// `a/src/b/c.rs` is module `b::c`.
pub(super) fn modules_of(path: &str) -> Vec<String> {
    let inside = path.split_once("src/").map_or(path, |(_, inside)| inside);
    let stem = inside.strip_suffix(".rs").unwrap_or(inside);
    let mut modules: Vec<String> = stem.split('/').map(str::to_owned).collect();
    if modules.last().is_some_and(|m| ["mod", "lib", "main"].contains(&m.as_str())) {
        modules.pop();
    }
    modules
}

struct Collector {
    /// The module being read.
    modules: Vec<String>,
    test: bool,
    found: Vec<Used>,
}

impl Collector {
    fn take(&mut self, written: Vec<String>, span: Span) {
        let segments = self.absolute(written);
        self.found.push(Used { segments, line: span.start().line, test: self.test });
    }

    /// Resolves `self` and `super` against the module being read.
    fn absolute(&self, written: Vec<String>) -> Vec<String> {
        let relative = written.iter().take_while(|s| *s == "self" || *s == "super").count();
        if relative == 0 {
            return written;
        }
        let up = written[..relative].iter().filter(|s| *s == "super").count();
        let kept = self.modules.len().saturating_sub(up);
        let mut segments = vec!["crate".to_owned()];
        segments.extend_from_slice(&self.modules[..kept]);
        segments.extend_from_slice(&written[relative..]);
        segments
    }

    fn take_tree(&mut self, tree: &UseTree, prefix: &[String]) {
        let with = |ident: &Ident| {
            let mut segments = prefix.to_vec();
            segments.push(ident.to_string());
            segments
        };
        match tree {
            UseTree::Path(path) => self.take_tree(&path.tree, &with(&path.ident)),
            UseTree::Name(name) => self.take(with(&name.ident), name.ident.span()),
            UseTree::Rename(rename) => self.take(with(&rename.ident), rename.ident.span()),
            UseTree::Glob(glob) => self.take(prefix.to_vec(), glob.star_token.spans[0]),
            UseTree::Group(group) => {
                for inner in &group.items {
                    self.take_tree(inner, prefix);
                }
            }
        }
    }

    fn take_tokens(&mut self, tokens: TokenStream) {
        let mut path: Vec<String> = Vec::new();
        let mut start = Span::call_site();
        let mut colons = 0;
        for token in tokens {
            match token {
                TokenTree::Punct(mark) if mark.as_char() == ':' => colons += 1,
                TokenTree::Ident(ident) => {
                    if colons != 2 {
                        self.take_unless_single(std::mem::take(&mut path), start);
                        start = ident.span();
                    }
                    path.push(ident.to_string());
                    colons = 0;
                }
                other => {
                    self.take_unless_single(std::mem::take(&mut path), start);
                    colons = 0;
                    if let TokenTree::Group(group) = other {
                        self.take_tokens(group.stream());
                    }
                }
            }
        }
        self.take_unless_single(path, start);
    }

    /// A lone word in a macro is a variable or the macro's own syntax.
    fn take_unless_single(&mut self, path: Vec<String>, span: Span) {
        if path.len() > 1 {
            self.take(path, span);
        }
    }
}

impl<'ast> Visit<'ast> for Collector {
    fn visit_item_use(&mut self, item: &'ast ItemUse) {
        self.take_tree(&item.tree, &[]);
    }

    fn visit_path(&mut self, path: &'ast Path) {
        let segments: Vec<String> = path.segments.iter().map(|s| s.ident.to_string()).collect();
        if segments.len() > 1 {
            let span = path.segments[0].ident.span();
            self.take(segments, span);
        }
        visit::visit_path(self, path);
    }

    fn visit_macro(&mut self, invocation: &'ast Macro) {
        self.take_tokens(invocation.tokens.clone());
        visit::visit_macro(self, invocation);
    }

    fn visit_item_mod(&mut self, module: &'ast ItemMod) {
        let outside = self.test;
        self.test |= module.attrs.iter().any(only_for_tests);
        self.modules.push(module.ident.to_string());
        visit::visit_item_mod(self, module);
        self.modules.pop();
        self.test = outside;
    }
}

/// `#[cfg(test)]`.
fn only_for_tests(attribute: &Attribute) -> bool {
    attribute.path().is_ident("cfg")
        && attribute.parse_args::<Ident>().is_ok_and(|condition| condition == "test")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn segments(path: &str, text: &str) -> Vec<String> {
        used(path, text).unwrap().into_iter().map(|u| u.segments.join("::")).collect()
    }

    #[test]
    fn use_trees_are_taken_apart() {
        let text = "use crate::{a::{B, c::*}, d as e};";
        assert_eq!(segments("x/src/lib.rs", text), ["crate::a::B", "crate::a::c", "crate::d"]);
    }

    #[test]
    fn relative_paths_become_absolute() {
        let text = "use super::B; mod tests { use super::{super::C, D}; } type T = self::E<u8>;";
        assert_eq!(
            segments("x/src/sets/zonotope.rs", text),
            [
                "crate::sets::B",
                "crate::sets::C",
                "crate::sets::zonotope::D",
                "crate::sets::zonotope::E"
            ]
        );
    }

    #[test]
    fn paths_inside_macros_and_expressions_are_seen() {
        let text = "fn f() { assert_eq!(vec![crate::a::b()], std::fs::read(x)); crate::g::h(); }";
        let found = segments("x/src/lib.rs", text);
        for expected in ["crate::a::b", "std::fs::read", "crate::g::h"] {
            assert!(found.iter().any(|f| f == expected), "{expected} not in {found:?}");
        }
    }

    #[test]
    fn test_modules_are_told_apart() {
        let text = "use std::fs;\n#[cfg(test)]\nmod tests { use std::net; }";
        let found = used("x/src/lib.rs", text).unwrap();
        assert_eq!((found[0].test, found[1].test), (false, true));
        assert_eq!(found[1].line, 3);
    }
}
