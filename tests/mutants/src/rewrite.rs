//! Writes a source file anew with all of its mutants in it, each behind a condition that is asked while the program runs.

use std::collections::BTreeSet;
use std::ops::Range;

use anyhow::{Context, Result};
use syn::spanned::Spanned;
use syn::visit::{self, Visit};

use crate::mutant::{Genre, Mutant, State};

/// A file with its mutants.
pub(crate) struct Rewritten {
    pub(crate) text: String,
    /// Where each mutant stands in `text`, by its number.
    pub(crate) places: Vec<(usize, Range<usize>)>,
}

/// What happens to a part of the source.
enum Edit {
    /// The expression has these alternatives.
    Instead(Vec<(usize, String)>),
    /// This is written before it.
    Before(usize, String),
    /// It is left out.
    Dropped,
}

struct Finder<'a> {
    source: &'a str,
    mutants: &'a [Mutant],
    /// Those of the file that are still wanted, by number, with the bytes that they change.
    wanted: Vec<(usize, Range<usize>)>,
    keep_const: &'a BTreeSet<String>,
    edits: Vec<(Range<usize>, Edit)>,
    placed: BTreeSet<usize>,
}

/// Writes `source` with those of `mutants` that are of `file` and wanted. Functions whose names are in `keep_const` are needed in
/// constants, where nothing can be asked: theirs are left out.
pub(crate) fn rewrite(
    file: &str,
    source: &str,
    mutants: &mut [Mutant],
    keep_const: &BTreeSet<String>,
) -> Result<Rewritten> {
    let tree = syn::parse_file(source).with_context(|| file.to_owned())?;
    let offset = |(line, column): (usize, usize)| {
        let start: usize = source.split_inclusive('\n').take(line - 1).map(str::len).sum();
        let rest = source.get(start..).unwrap_or_default();
        start + rest.chars().take(column - 1).map(char::len_utf8).sum::<usize>()
    };
    let wanted = mutants.iter().enumerate().filter(|(_, mutant)| mutant.file == file && mutant.state == State::Wanted);
    let wanted = wanted.map(|(number, mutant)| (number, offset(mutant.start)..offset(mutant.end))).collect();
    let (edits, placed) = (Vec::new(), BTreeSet::new());
    let mut finder = Finder { source, mutants, wanted, keep_const, edits, placed };
    finder.visit_file(&tree);
    let Finder { mut edits, placed, wanted, .. } = finder;
    for (number, _) in wanted.iter().filter(|(number, _)| !placed.contains(number)) {
        mutants[*number].state = State::Untried;
    }
    // Outer ones first; what is written before something stands before that.
    let rank = |edit: &Edit| !matches!(edit, Edit::Before(..));
    edits.sort_by_key(|(range, edit)| (range.start, rank(edit), std::cmp::Reverse(range.end)));
    let mut rewritten = Rewritten { text: String::new(), places: Vec::new() };
    rewritten.write(source, 0..source.len(), &edits);
    Ok(rewritten)
}

impl Rewritten {
    fn write(&mut self, source: &str, range: Range<usize>, edits: &[(Range<usize>, Edit)]) {
        let (mut at, mut index) = (range.start, 0);
        while let Some((place, edit)) = edits.get(index) {
            self.text.push_str(&source[at..place.start]);
            index += 1;
            at = place.start;
            match edit {
                Edit::Before(number, text) => self.mark(*number, text),
                Edit::Dropped => at = place.end,
                Edit::Instead(alternatives) => {
                    self.text.push('(');
                    for (number, text) in alternatives {
                        self.mark(*number, &format!("if crate::mutant::on({number}) {{ {text} }} else "));
                    }
                    let inner = edits[index..].iter().take_while(|(inner, _)| inner.start < place.end).count();
                    self.text.push_str("{ ");
                    self.write(source, place.clone(), &edits[index..index + inner]);
                    self.text.push_str(" })");
                    index += inner;
                    at = place.end;
                }
            }
        }
        self.text.push_str(&source[at..range.end]);
    }

    fn mark(&mut self, number: usize, text: &str) {
        let start = self.text.len();
        self.text.push_str(text);
        self.places.push((number, start..self.text.len()));
    }
}

impl Finder<'_> {
    fn at(&self, genre: Genre, start: usize) -> Vec<usize> {
        let fits = |(number, range): &&(usize, Range<usize>)| {
            range.start == start && self.mutants[*number].genre == genre && !self.placed.contains(number)
        };
        self.wanted.iter().filter(fits).map(|(number, _)| *number).collect()
    }

    fn instead(&mut self, range: Range<usize>, numbers: Vec<usize>, text: impl Fn(&Mutant) -> String) {
        if numbers.is_empty() {
            return;
        }
        self.placed.extend(&numbers);
        let alternatives = numbers.iter().map(|number| (*number, text(&self.mutants[*number]))).collect::<Vec<_>>();
        match self.edits.iter_mut().find(|(known, edit)| *known == range && matches!(edit, Edit::Instead(_))) {
            Some((_, Edit::Instead(known))) => known.extend(alternatives),
            _ => self.edits.push((range, Edit::Instead(alternatives))),
        }
    }

    /// What is in a function: its value, and whether it can stay constant.
    fn function(&mut self, signature: &syn::Signature, body: &syn::Block) -> bool {
        let range = body.span().byte_range();
        let within = |(_, place): &&(usize, Range<usize>)| range.start <= place.start && place.end <= range.end;
        if self.wanted.iter().filter(within).count() == 0 {
            return true;
        }
        if let Some(constness) = &signature.constness {
            if self.keep_const.contains(&signature.ident.to_string()) {
                return false;
            }
            self.edits.push((constness.span().byte_range(), Edit::Dropped));
        }
        let mine = |(number, place): &&(usize, Range<usize>)| {
            self.mutants[*number].genre == Genre::Value
                && !self.placed.contains(number)
                && body.stmts.first().is_some_and(|first| first.span().byte_range().start == place.start)
        };
        // Behind `impl Trait` the value and what replaces it are two types.
        let is_opaque = matches!(&signature.output, syn::ReturnType::Type(_, output) if names_no_type(output));
        let values: Vec<_> = self.wanted.iter().filter(mine).filter(|_| !is_opaque).cloned().collect();
        for (number, place) in values {
            self.placed.insert(number);
            let text = format!("if crate::mutant::on({number}) {{ return {}; }} ", self.mutants[number].replacement);
            self.edits.push((place.start..place.start, Edit::Before(number, text)));
        }
        true
    }
}

/// Whether a function's type is, or has in it, `impl Trait`.
fn names_no_type(output: &syn::Type) -> bool {
    struct Opaque(bool);
    impl Visit<'_> for Opaque {
        fn visit_type_impl_trait(&mut self, _: &syn::TypeImplTrait) {
            self.0 = true;
        }
    }
    let mut opaque = Opaque(false);
    opaque.visit_type(output);
    opaque.0
}

/// Whether an expression is, or ends in, a pattern, which only a condition may be.
fn has_let(expression: &syn::Expr) -> bool {
    match expression {
        syn::Expr::Let(_) => true,
        syn::Expr::Binary(binary) => has_let(&binary.left) || has_let(&binary.right),
        _ => false,
    }
}

impl<'ast> Visit<'ast> for Finder<'_> {
    fn visit_item_fn(&mut self, item: &'ast syn::ItemFn) {
        if self.function(&item.sig, &item.block) {
            visit::visit_item_fn(self, item);
        }
    }

    fn visit_impl_item_fn(&mut self, item: &'ast syn::ImplItemFn) {
        if self.function(&item.sig, &item.block) {
            visit::visit_impl_item_fn(self, item);
        }
    }

    fn visit_trait_item_fn(&mut self, item: &'ast syn::TraitItemFn) {
        if item.default.as_ref().is_none_or(|body| self.function(&item.sig, body)) {
            visit::visit_trait_item_fn(self, item);
        }
    }

    fn visit_expr_binary(&mut self, binary: &'ast syn::ExprBinary) {
        let operator = binary.op.span().byte_range();
        if !has_let(&binary.left) && !has_let(&binary.right) {
            let [left, right] = [&binary.left, &binary.right].map(|side| &self.source[side.span().byte_range()]);
            let text = |mutant: &Mutant| format!("({left}) {} ({right})", mutant.replacement);
            self.instead(binary.span().byte_range(), self.at(Genre::Binary, operator.start), text);
        }
        visit::visit_expr_binary(self, binary);
    }

    fn visit_expr_unary(&mut self, unary: &'ast syn::ExprUnary) {
        let range = unary.span().byte_range();
        let operand = &self.source[unary.expr.span().byte_range()];
        self.instead(range.clone(), self.at(Genre::Unary, range.start), |_| operand.to_owned());
        visit::visit_expr_unary(self, unary);
    }

    fn visit_arm(&mut self, arm: &'ast syn::Arm) {
        let deleted = self.at(Genre::Arm, arm.span().byte_range().start);
        match &arm.guard {
            Some((_, guard)) if !has_let(guard) => {
                let range = guard.span().byte_range();
                self.instead(range.clone(), deleted, |_| "false".to_owned());
                self.instead(range.clone(), self.at(Genre::Guard, range.start), |mutant| mutant.replacement.clone());
            }
            Some(_) => {}
            None => {
                let arrow = arm.fat_arrow_token.span().byte_range().start;
                for number in deleted {
                    self.placed.insert(number);
                    let text = format!("if !crate::mutant::on({number}) ");
                    self.edits.push((arrow..arrow, Edit::Before(number, text)));
                }
            }
        }
        visit::visit_arm(self, arm);
    }
}
