"""The model card is readable: nested records as lists, rows of numbers as tables."""

from bathyscope_export.card import items


def test_rows_of_equal_columns_become_a_table_and_the_rest_lists() -> None:
    record = {
        "step": 3,
        "settings": {"loss": {"depth": 1.0}, "data": [{"folder": "a", "domain": None}]},
        "notes": ["first", "second"],
        "real": {"a": {"abs_rel": 0.1, "delta1": 0.9}, "b": {"abs_rel": 0.2, "delta1": 0.8}},
    }
    assert items(record) == [
        "* step: 3",
        "* settings:",
        "  * loss:",
        "    * depth: 1.0",
        "  * data:",
        "    * folder a",
        "* notes:",
        "  * first",
        "  * second",
        "* real:",
        "",
        "| | abs rel | delta1 |",
        "| --- | --- | --- |",
        "| a | 0.1 | 0.9 |",
        "| b | 0.2 | 0.8 |",
        "",
    ]


def test_an_empty_record_says_so() -> None:
    assert items({}) == ["Nothing is recorded."]
