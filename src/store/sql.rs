//! What a statement asks, found out before anything is opened.

use sqlparser::ast::{Expr, Ident, OrderByKind, Query, SelectItem, SetExpr, Statement};
use sqlparser::dialect::GenericDialect;
use sqlparser::parser::{Parser, ParserOptions};

/// A statement, as far as it can be told without tables.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StatementKind {
    /// A query; `named` is the same with a name for each computed column of the answer.
    Rows { named: Option<String> },
    /// `show tables`.
    Tables,
    /// `describe TABLE`, or `show columns from TABLE`.
    Columns { table: String },
}

/// Reads a statement.
///
/// # Errors
/// One sentence for what is no question.
pub fn read(sql: &str) -> Result<StatementKind, String> {
    let statements = Parser::new(&GenericDialect)
        // As the engine reads it.
        .with_options(ParserOptions { trailing_commas: true, ..ParserOptions::default() })
        .try_with_sql(sql)
        .and_then(|mut parser| parser.parse_statements());
    let statements = match statements {
        Ok(statements) => statements,
        Err(error) => {
            // A statement of another kind may be of another dialect, too.
            let verb = first_word(sql);
            let is_other = OTHER_VERBS.contains(&verb.as_str());
            return Err(if is_other { refusal(&verb) } else { error.to_string() });
        }
    };
    match statements.as_slice() {
        [] => {
            Err("the statement is empty; ask for example \"select count(*) from phrases\"".into())
        }
        [statement] => asked(statement, sql),
        _ => Err("there are several statements; ask them one after the other".into()),
    }
}

/// Statements that change something, or tell of what this program has not.
const OTHER_VERBS: [&str; 16] = [
    "alter", "analyze", "attach", "call", "copy", "create", "delete", "drop", "grant", "insert",
    "merge", "pragma", "set", "truncate", "update", "vacuum",
];

fn refusal(verb: &str) -> String {
    format!(
        "\"{verb}\" is not answered: tables are read here, and changed by stages alone; begin with \"select\", \
         \"show tables\" or \"describe\""
    )
}

fn asked(statement: &Statement, sql: &str) -> Result<StatementKind, String> {
    match statement {
        Statement::Query(query) => Ok(StatementKind::Rows { named: named(query) }),
        Statement::Explain { .. } => Ok(StatementKind::Rows { named: None }),
        Statement::ShowTables { .. } => Ok(StatementKind::Tables),
        Statement::ExplainTable { table_name, .. } => {
            Ok(StatementKind::Columns { table: unquoted(&table_name.to_string()) })
        }
        Statement::ShowColumns { .. } => {
            let table = sql.trim_end().trim_end_matches(';').split_whitespace().last();
            Ok(StatementKind::Columns { table: unquoted(table.unwrap_or_default()) })
        }
        other => Err(refusal(&first_word(&other.to_string()))),
    }
}

fn unquoted(name: &str) -> String {
    name.trim_matches(['"', '`']).to_owned()
}

fn first_word(text: &str) -> String {
    let word = text.trim_start().split(|c: char| !c.is_alphanumeric()).next();
    word.unwrap_or_default().to_lowercase()
}

/// Returns a query whose computed columns are called as they are written, such as `min(rms)`, and so are columns
/// of several tables that have one name; none where there are no such columns.
///
/// The engine calls them as the column that they are computed from, and so refuses two of one column.
fn named(query: &Query) -> Option<String> {
    let mut query = query.clone();
    let SetExpr::Select(select) = query.body.as_mut() else { return None };
    let columns: Vec<String> = select.projection.iter().filter_map(column_of_item).collect();
    let mut names: Vec<(Expr, String)> = Vec::new();
    for item in &mut select.projection {
        let SelectItem::UnnamedExpr(expr) = item else { continue };
        let is_column = matches!(expr, Expr::Identifier(_) | Expr::CompoundIdentifier(_));
        let is_one_of_many = column_of(expr)
            .is_some_and(|column| columns.iter().filter(|other| **other == column).count() > 1);
        if is_column && !(is_one_of_many && matches!(expr, Expr::CompoundIdentifier(_))) {
            continue;
        }
        let text = expr.to_string().replace('"', "");
        let n_before = names.iter().filter(|(before, _)| before == expr).count();
        // An expression that is selected twice gets two columns.
        let name = if n_before == 0 { text } else { format!("{text} {}", n_before + 1) };
        names.push((expr.clone(), name.clone()));
        *item =
            SelectItem::ExprWithAlias { expr: expr.clone(), alias: Ident::with_quote('"', name) };
    }
    if names.is_empty() {
        return None;
    }
    let order = query.order_by.as_mut().map(|order| &mut order.kind);
    if let Some(OrderByKind::Expressions(keys)) = order {
        for key in keys {
            if let Some((_, name)) = names.iter().find(|(expr, _)| *expr == key.expr) {
                key.expr = Expr::Identifier(Ident::with_quote('"', name.clone()));
            }
        }
    }
    Some(query.to_string())
}

/// Returns the name of the column that an item of a selection is, where it is one.
fn column_of_item(item: &SelectItem) -> Option<String> {
    match item {
        SelectItem::UnnamedExpr(expr) => column_of(expr),
        SelectItem::ExprWithAlias { alias, .. } => Some(alias.value.clone()),
        _ => None,
    }
}

fn column_of(expr: &Expr) -> Option<String> {
    match expr {
        Expr::Identifier(name) => Some(name.value.clone()),
        Expr::CompoundIdentifier(names) => names.last().map(|name| name.value.clone()),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn named_sql(sql: &str) -> Option<String> {
        match read(sql) {
            Ok(StatementKind::Rows { named }) => named,
            other => panic!("{sql}: {other:?}"),
        }
    }

    #[test]
    fn computed_columns_are_called_as_they_are_written() {
        for (sql, expected) in [
            (
                "select min(rms), max(rms) from features",
                "SELECT min(rms) AS \"min(rms)\", max(rms) AS \"max(rms)\" FROM features",
            ),
            (
                "select split, count(*) from p group by split order by count(*) desc, split",
                "SELECT split, count(*) AS \"count(*)\" FROM p GROUP BY split ORDER BY \
                 \"count(*)\" DESC, split",
            ),
            (
                "select sum(x), sum(x) from t",
                "SELECT sum(x) AS \"sum(x)\", sum(x) AS \"sum(x) 2\" FROM t",
            ),
            (
                "select p.id, q.id, p.n from p join q on p.n = q.n",
                "SELECT p.id AS \"p.id\", q.id AS \"q.id\", p.n FROM p JOIN q ON p.n = q.n",
            ),
            ("select max(\"x\") from t", "SELECT max(\"x\") AS \"max(x)\" FROM t"),
        ] {
            assert_eq!(named_sql(sql).as_deref(), Some(expected), "{sql}");
        }
        for sql in [
            "select a, t.b, count(*) n from t",
            "select * from t",
            "select min(x) from t union all select max(x) from t",
        ] {
            let named = named_sql(sql);
            assert!(named.is_none(), "{sql}: {named:?}");
        }
    }

    #[test]
    fn other_statements_are_told_apart() {
        let columns = |table: &str| Ok(StatementKind::Columns { table: table.to_owned() });
        assert_eq!(read("show tables"), Ok(StatementKind::Tables));
        assert_eq!(read("-- all\nSHOW TABLES;"), Ok(StatementKind::Tables));
        assert_eq!(read("describe phrases"), columns("phrases"));
        assert_eq!(read("desc \"beats\""), columns("beats"));
        assert_eq!(read("show columns from motion;"), columns("motion"));
        for verb in OTHER_VERBS {
            let refused = read(&format!("{verb} phrases x y z")).expect_err(verb);
            assert_eq!(refused, refusal(verb));
        }
        let refused = read("/* x */ drop table phrases").expect_err("a change");
        assert!(refused.starts_with("\"drop\" is not answered"), "{refused}");
        assert!(read("").expect_err("nothing").starts_with("the statement is empty"));
        assert!(read("select 1; select 2").expect_err("two").starts_with("there are several"));
        assert!(read("selct a from b").expect_err("no SQL").contains("selct"));
    }
}
