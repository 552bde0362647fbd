//! The text of the project.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs, io,
    path::Path,
};

/// Endings of the files that are read; everything else is only listed.
const READ: [&str; 9] = ["rs", "toml", "lock", "proto", "md", "py", "sh", "yaml", "yml"];
/// Larger files are golden data, not text written for people.
const BYTES_MAX: u64 = 1 << 20;

/// Files by path from the project's root, with `/` between the parts.
#[derive(Debug, Clone, Default)]
pub struct Tree {
    /// Text of each file that was read; empty for one that was only listed.
    pub files: BTreeMap<String, String>,
    /// Names of the folders at the root.
    pub folders: BTreeSet<String>,
}

impl Tree {
    /// Reads the project at `root`.
    ///
    /// # Errors
    /// Whatever the file system says.
    pub fn read(root: &Path) -> io::Result<Self> {
        let mut tree = Self::default();
        for entry in fs::read_dir(root)? {
            let entry = entry?;
            let name = entry.file_name().to_string_lossy().into_owned();
            // What git does not keep is not part of the house, nor are the folders of tools.
            let hidden = name.starts_with('.') && name != ".ci" && entry.file_type()?.is_dir();
            if hidden || ["target", "out", ".git"].contains(&name.as_str()) {
                continue;
            }
            if entry.file_type()?.is_dir() {
                tree.read_folder(&entry.path(), &name)?;
                tree.folders.insert(name);
            } else {
                tree.read_file(&entry.path(), name)?;
            }
        }
        Ok(tree)
    }

    /// A tree made of `(path, text)`.
    #[must_use]
    pub fn of(files: &[(&str, &str)]) -> Self {
        let mut tree = Self::default();
        for (path, text) in files {
            if let Some((folder, _)) = path.split_once('/') {
                tree.folders.insert(folder.to_owned());
            }
            tree.files.insert((*path).to_owned(), (*text).to_owned());
        }
        tree
    }

    /// The text of one file.
    #[must_use]
    pub fn text(&self, path: &str) -> Option<&str> {
        self.files.get(path).map(String::as_str)
    }

    /// Files below `folder` whose names end in `.{ending}`.
    pub fn below<'a>(
        &'a self,
        folder: &'a str,
        ending: &'a str,
    ) -> impl Iterator<Item = (&'a str, &'a str)> {
        self.files.iter().filter_map(move |(path, text)| {
            let inside = path.strip_prefix(folder)?.starts_with('/') || folder.is_empty();
            let named = path.rsplit_once('.').is_some_and(|(_, e)| e == ending);
            (inside && named).then_some((path.as_str(), text.as_str()))
        })
    }

    /// Some file lies in `folder`.
    #[must_use]
    pub fn has_folder(&self, folder: &str) -> bool {
        self.files.keys().any(|p| p.strip_prefix(folder).is_some_and(|rest| rest.starts_with('/')))
    }

    fn read_folder(&mut self, folder: &Path, path: &str) -> io::Result<()> {
        for entry in fs::read_dir(folder)? {
            let entry = entry?;
            let name = entry.file_name().to_string_lossy().into_owned();
            let path = format!("{path}/{name}");
            if entry.file_type()?.is_dir() {
                if name != "__pycache__" {
                    self.read_folder(&entry.path(), &path)?;
                }
            } else {
                self.read_file(&entry.path(), path)?;
            }
        }
        Ok(())
    }

    fn read_file(&mut self, file: &Path, path: String) -> io::Result<()> {
        let ending = path.rsplit_once('.').map_or("", |(_, ending)| ending);
        let mission = path.starts_with("simulator/missions/") && ending == "json";
        let readable = READ.contains(&ending) || path == ".ci/run" || mission;
        let text = if readable && fs::metadata(file)?.len() <= BYTES_MAX {
            fs::read_to_string(file)?
        } else {
            String::new()
        };
        self.files.insert(path, text);
        Ok(())
    }
}
