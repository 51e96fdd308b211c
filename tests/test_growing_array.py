"""Arrays and tables that grow hold what a list would."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanchain.growing_array import Columns, GrowingArray, read_only

BATCHES = st.lists(st.lists(st.tuples(st.integers(-9, 9), st.integers(-9, 9)), max_size=40), max_size=6)


@given(BATCHES)
def test_rows_appended_one_by_one_or_many_at_once_are_those_of_a_list(batches):
    array, expected = GrowingArray((2,), np.int64), []
    for batch in batches:
        before, seen = array.rows, list(expected)
        if len(batch) == 1:
            assert array.append(batch[0]) == len(expected)
        else:
            array.extend(np.array(batch, np.int64).reshape(-1, 2))
        expected += batch
        assert len(array) == len(expected) and array.rows.tolist() == [list(row) for row in expected]
        assert before.tolist() == [list(row) for row in seen]


def test_views_of_before_keep_the_rows_that_are_replaced_and_what_replaces_them_is_copied():
    array = GrowingArray((), np.float64)
    array.extend(np.arange(5.0))
    before, new = array.rows, np.array([7.0, 8.0])
    array.replace(new)
    new[0] = 0.0
    array.append(9.0)
    assert before.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0] and array.rows.tolist() == [7.0, 8.0, 9.0]


def test_views_cannot_be_written_to_and_leave_the_array_itself_writeable():
    array, own = GrowingArray((2,), np.float64), np.zeros(3)
    array.append([1.0, 2.0])
    for view in (array.rows, read_only(own)):
        with pytest.raises(ValueError, match="read-only"):
            view[0] = 5.0
    own[0] = 1.0
    assert np.shares_memory(own, read_only(own))


def test_columns_hold_numbers_arrays_and_texts_by_their_code():
    table = Columns()
    assert len(table) == 0 and table["absent"].size == 0 and table.texts == []
    for k in range(40):
        table.append({"n": k, "share": 0.5 * k, "T": np.full((2, 2), k), "why": ("near", "far")[k % 3 == 0]})
    assert len(table) == 40 and table["n"].tolist() == list(range(40)) and table["n"].dtype.kind == "i"
    assert table["share"].tolist() == [0.5 * k for k in range(40)] and table["T"].shape == (40, 2, 2)
    assert [table.texts[code] for code in table["why"]] == [("near", "far")[k % 3 == 0] for k in range(40)]
    assert table.texts == ["far", "near"]
