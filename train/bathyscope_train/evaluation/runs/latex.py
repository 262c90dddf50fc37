"""The summary of an evaluation as LaTeX tables in the shape of the paper's; needs booktabs and multirow."""

from __future__ import annotations

from collections.abc import Sequence

from bathyscope_train.evaluation.runs.cells import HIGHER_IS_BETTER, NOTHING, best, number
from bathyscope_train.evaluation.runs.layouts import CELLS, NO, YES, Layout
from bathyscope_train.evaluation.runs.records import ALL_FRAMES
from bathyscope_train.evaluation.runs.run import RunOutcome
from bathyscope_train.evaluation.runs.statements import (
    data_statement,
    incomplete_statement,
    interval_statement,
    system_statements,
)
from bathyscope_train.evaluation.runs.summary import Line

_TITLES = {
    "abs_rel": "Abs Rel",
    "sq_rel": "Sq Rel",
    "rmse": "RMSE",
    "rmse_log": "RMSE log",
    "delta1": r"$\boldsymbol{\delta}_1$",
    "delta2": r"$\boldsymbol{\delta}_2$",
    "delta3": r"$\boldsymbol{\delta}_3$",
}
_HEADS = {
    Layout.COMPARISON: ("Method", "Year"),
    Layout.COMPONENTS: ("Method", *(rf"$\mathcal{{L}}_{{\text{{{loss}}}}}$" for loss in ("rgb", "3D", "temp"))),
    Layout.BACKBONES: ("Backbone", "Consistency"),
}
_SPECIAL = str.maketrans({c: f"\\{c}" for c in "&%$#_{}"} | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}"})
_SIGNS = {YES: r"$\checkmark$", NO: r"$\times$", NOTHING: "--", "×": r"$\times$"}


def latex(outcome: RunOutcome, lines: Sequence[Line], layout: Layout) -> str:
    """One table over all data sets, with everything that must stand beside a number in its notes."""
    columns = outcome.protocol.columns
    head = ["Dataset", *_HEADS[layout], *(_column(name) for name in columns)]
    body = []
    keys = dict.fromkeys((line.dataset, line.group) for line in lines)
    for dataset, group in keys:
        mine = [line for line in lines if (line.dataset, line.group) == (dataset, group)]
        name = dataset if group == ALL_FRAMES else f"{dataset}, {group}"
        body.append("\\midrule\n" + _block(name, mine, columns, layout))
    return "\n".join(
        [
            r"\begin{table*}[t]",
            r"\centering",
            rf"\caption{{Depth errors, protocol {escaped(outcome.protocol.name)}. "
            r"$\downarrow$ lower, $\uparrow$ higher is better.}",
            r"\resizebox{\textwidth}{!}{",
            rf"\begin{{tabular}}{{l{'l' + 'c' * (len(head) - 2)}}}",
            r"\toprule",
            " & ".join(head) + r" \\",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            "}",
            *_notes(outcome, lines),
            r"\end{table*}",
            "",
        ]
    )


def escaped(text: str) -> str:
    """Text as LaTeX prints it."""
    return text.translate(_SPECIAL).replace("δ", r"$\delta$").replace("–", "--")


def _column(name: str) -> str:
    return f"{_TITLES[name]} {'$' + chr(92) + ('uparrow' if name in HIGHER_IS_BETTER else 'downarrow') + '$'}"


def _block(dataset: str, lines: Sequence[Line], columns: Sequence[str], layout: Layout) -> str:
    winners = {name: best(lines, name) for name in columns}
    rows = []
    for count, line in enumerate(lines):
        first = rf"\multirow{{{len(lines)}}}{{*}}{{{escaped(dataset)}}}" if count == 0 else ""
        cells = [_SIGNS.get(cell, escaped(cell)) for cell in CELLS[layout](line.system)]
        if line.missing is not None:
            cells.append(rf"\multicolumn{{{len(columns)}}}{{c}}{{{escaped(line.missing.split(':')[0])}}}")
        else:
            cells += [_cell(line, name, line.system in winners[name]) for name in columns]
        rows.append(" & ".join([first, *cells]) + r" \\")
    return "\n".join(rows)


def _cell(line: Line, name: str, bold: bool) -> str:
    text = number(line.values[name])
    text = _SIGNS.get(text, text) + ("" if line.complete else "$^*$")
    return rf"\textbf{{{text}}}" if bold else text


def _notes(outcome: RunOutcome, lines: Sequence[Line]) -> list[str]:
    sentences = [*outcome.protocol.words(), interval_statement(outcome.protocol)]
    for label, chosen in outcome.data.items():
        for group in dict.fromkeys(line.group for line in lines if line.dataset == label):
            mine = [line for line in lines if (line.dataset, line.group) == (label, group)]
            sentences.append(data_statement(label, chosen, mine))
            sentences += [text for line in mine if (text := incomplete_statement(line)) is not None]
    sentences += system_statements(lines)
    return [r"\par\smallskip\footnotesize", *(escaped(sentence) for sentence in sentences)]
