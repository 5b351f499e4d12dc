"""Every file of the list gives the right map or a clear refusal; none is silently wrong."""

import re

import numpy as np
import pytest

from map_files import CASES, Read
from optical_palpation.errors import InputError
from optical_palpation.thickness import read_thickness_map


def test_the_list_is_long():
    assert len(CASES) >= 150


@pytest.mark.parametrize("name", CASES)
def test_right_or_refused(name, tmp_path):
    write, options, answer = CASES[name]
    path = write(tmp_path)
    if not isinstance(answer, Read):
        with pytest.raises(InputError) as caught:
            read_thickness_map(path, **options)
        assert re.search(answer.says, str(caught.value)), caught.value
        assert path.name in str(caught.value)
        return
    found = read_thickness_map(path, **options)
    np.testing.assert_allclose(found.values, answer.values, rtol=2e-7)
    assert found.dims == ("y", "x")
    rows, columns = answer.values.shape
    if answer.x is not None:
        np.testing.assert_allclose(found.x, answer.x, atol=1e-9)
        np.testing.assert_allclose(found.y, answer.y, atol=1e-9)
    else:
        width, height = options["field_of_view"]
        np.testing.assert_allclose(found.x, np.linspace(0, width, columns))
        np.testing.assert_allclose(found.y, np.linspace(0, height, rows))
