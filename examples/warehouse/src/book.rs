//! The managers' book: which cells each vehicle may be in, and what has become of each order. It outlives a manager, and only the
//! one with the newest term may write into it.
//!
//! A line is written before what it says is done, so that what stands in it is never less than what may have happened:
//!
//! Managers of one host share the file and its lock here. In a plant it is a table of a database, or a service with a copy; a manager that
//! stands still while it holds the lock would hold up the next one.
//!
//! | line | says |
//! |---|---|
//! | `term 3` | a manager with this term writes from here on; those with older ones no more |
//! | `grant agv-7 3,4 3,5` | the vehicle may be in these two cells |
//! | `pick agv-7 12` | the vehicle may have the parcel of this order |
//! | `done 12` | the parcel lies where it was to lie |

use std::collections::{HashMap, HashSet};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::Path;

use crate::map::Cell;

/// Why nothing was written.
#[derive(Debug, thiserror::Error)]
pub enum BookError {
    /// This manager is to do nothing any more.
    #[error("a manager with the newer term {0} writes into the book")]
    Fenced(u64),
    /// The file.
    #[error("the managers' book: {0}")]
    File(#[from] std::io::Error),
}

/// What earlier managers have written.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Written {
    /// The cells of each vehicle.
    pub cells: HashMap<String, [Cell; 2]>,
    /// The vehicle that may have the parcel of each order.
    pub picked: HashMap<usize, String>,
    /// Orders that are done.
    pub done: HashSet<usize>,
}

/// The book, open for one manager.
#[derive(Debug)]
pub struct Book {
    file: File,
    term: u64,
    /// Bytes that have been read or written here.
    known: u64,
}

impl Book {
    /// Opens it for a manager with this term, and says so in it. What stands there already is returned.
    pub fn open(path: &Path, term: u64) -> Result<(Self, Written), BookError> {
        let file = File::options().read(true).append(true).create(true).open(path)?;
        let mut book = Self { file, term, known: 0 };
        let mut written = Written::default();
        book.file.lock()?;
        let opened = book.read_on(&mut written).and_then(|()| book.append(&format!("term {term}\n")));
        book.file.unlock()?;
        opened.map(|()| (book, written))
    }

    /// Writes whole lines, unless a newer manager has come.
    pub fn write(&mut self, lines: &str) -> Result<(), BookError> {
        self.file.lock()?;
        let appended = self.read_on(&mut Written::default()).and_then(|()| self.append(lines));
        self.file.unlock()?;
        appended
    }

    fn append(&mut self, lines: &str) -> Result<(), BookError> {
        self.file.write_all(lines.as_bytes())?;
        self.known += lines.len() as u64;
        Ok(())
    }

    /// Reads what others have written meanwhile.
    fn read_on(&mut self, written: &mut Written) -> Result<(), BookError> {
        let length = self.file.metadata()?.len();
        if length == self.known {
            return Ok(());
        }
        let mut text = String::new();
        self.file.seek(SeekFrom::Start(self.known))?;
        self.file.read_to_string(&mut text)?;
        // A manager that was killed while it wrote has left part of a line, and has not done what that one says.
        if !text.ends_with('\n') {
            self.file.write_all(b"\n")?;
            text.push('\n');
        }
        self.known += text.len() as u64;
        let newest = text.lines().filter_map(|line| written.take(line)).max();
        match newest.filter(|newest| *newest > self.term) {
            Some(newest) => Err(BookError::Fenced(newest)),
            None => Ok(()),
        }
    }
}

impl Written {
    /// Takes a line over; a term is returned. What is no line of a book changes nothing.
    fn take(&mut self, line: &str) -> Option<u64> {
        match line.split(' ').collect::<Vec<_>>()[..] {
            ["term", term] => return term.parse().ok(),
            ["grant", vehicle, at, next] => {
                if let (Ok(at), Ok(next)) = (at.parse(), next.parse()) {
                    self.cells.insert(vehicle.to_owned(), [at, next]);
                }
            }
            ["pick", vehicle, order] => {
                if let Ok(order) = order.parse() {
                    self.picked.insert(order, vehicle.to_owned());
                }
            }
            ["done", order] => self.done.extend(order.parse::<usize>()),
            _ => {}
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::{Book, BookError, Written};
    use crate::map::Cell;

    #[test]
    fn a_new_manager_reads_and_an_old_one_writes_no_more() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("book");
        let (mut first, written) = Book::open(&path, 1).unwrap();
        assert_eq!(written, Written::default());
        first.write("grant agv-7 3,4 3,5\npick agv-7 12\n").unwrap();
        first.write("done 11\n").unwrap();
        let (mut second, written) = Book::open(&path, 2).unwrap();
        assert_eq!(written.cells["agv-7"], [Cell { x: 3, y: 4 }, Cell { x: 3, y: 5 }]);
        assert_eq!(written.picked[&12], "agv-7");
        assert!(written.done.contains(&11) && written.done.len() == 1);
        assert!(matches!(first.write("grant agv-7 3,5 3,6\n"), Err(BookError::Fenced(2))));
        second.write("done 12\n").unwrap();
        let (_, written) = Book::open(&path, 3).unwrap();
        assert_eq!(written.cells["agv-7"], [Cell { x: 3, y: 4 }, Cell { x: 3, y: 5 }]);
        assert!(written.done.contains(&12));
        assert!(matches!(Book::open(&path, 2), Err(BookError::Fenced(3))));
    }

    #[test]
    fn half_a_line_does_not_spoil_the_next() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("book");
        std::fs::write(&path, "done 3\ngrant agv-1 1,").unwrap();
        let (mut book, written) = Book::open(&path, 1).unwrap();
        assert!(written.cells.is_empty() && written.done.contains(&3));
        book.write("done 4\n").unwrap();
        assert!(Book::open(&path, 2).unwrap().1.done.contains(&4));
    }
}
