import pytest

from prtbake_storage.contract.brdf_fits import AbcSpec, SgdSpec
from prtbake_storage.errors import BrdfError
from prtbake_workers.brdf.fit_tables import (
    MAX_ROWS,
    RGB,
    SGD_COLUMNS,
    is_fit_table,
    read_fit_table,
)

ABC = "name,kD_r,kD_g,kD_b,A_r,A_g,A_b,B,C,ior\n"
ABC_ROWS = "one,0.1,0.2,0.3,10,20,30,500,1.5,1.4\ntwo,0,0,0,1,1,1,2,3,1.1\n"


def sgd_table(**changes):
    """Two rows whose numbers tell where they came from, with a column of errors behind them."""
    columns = [name + suffix for name in SGD_COLUMNS for suffix in RGB]
    values = {
        column: round(0.25 + 0.01 * index, 2) for index, column in enumerate(columns)
    } | changes
    header = ",".join(["name", "other_name", *columns, "error_r"])
    row = ",".join(str(values[column]) for column in columns)
    return f"{header}\nplain,,{row},9\nshiny,very-shiny,{row},9\n".encode()


def test_abc_rows_are_found_by_name():
    spec = read_fit_table((ABC + ABC_ROWS).encode(), "one")
    assert spec == AbcSpec(kd=(0.1, 0.2, 0.3), a=(10, 20, 30), b=500, c=1.5, ior=1.4)
    assert read_fit_table((ABC + ABC_ROWS).encode(), "two").ior == 1.1


def test_sgd_columns_fill_their_fields():
    spec = read_fit_table(sgd_table(), "very-shiny")
    assert isinstance(spec, SgdSpec)
    assert spec.rho_d == (0.25, 0.26, 0.27)
    assert spec.kappa == (0.43, 0.44, 0.45)
    assert spec.lam == (0.46, 0.47, 0.48)
    assert spec.theta0 == (0.55, 0.56, 0.57)
    assert read_fit_table(sgd_table(), "plain") == spec


@pytest.mark.parametrize("material", [None, "three", ""])
def test_without_a_name_of_the_table_its_names_are_told(material):
    table = (ABC + "".join(f"m{n},0,0,0,1,1,1,2,3,1.1\n" for n in range(20))).encode()
    with pytest.raises(BrdfError, match=r"m0, m1, .* and 12 more") as caught:
        read_fit_table(table, material)
    assert caught.value.pointer == "/material"


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (ABC.replace("ior", "n") + ABC_ROWS, "for abc it lacks ior"),
        ("name,rhoD_r\nx,1\n", "neither that of SGD nor of ABC"),
        (ABC + "one,0.1,0.2,x,10,20,30,500,1.5,1.4\n", r"line 2 \(one\), column kD_b: 'x'"),
        (ABC + "one,0.1,0.2\n", "column kD_b: None is no number"),
        (ABC + "one,0.1,0.2,nan,10,20,30,500,1.5,1.4\n", "'nan' is no number"),
        (ABC + "one,0.1,0.2,0.3,10,20,30,500,1.5,0.5\n", "ior: .*greater than or equal to 1"),
        (ABC + "one,0.1,0.2,0.3,10,-20,30,500,1.5,1.4\n", "a/1: .*greater than or equal to 0"),
        (ABC + "x,0,0,0,1,1,1,2,3,1.1\n" * (MAX_ROWS + 1), "more than 10000 rows"),
        (ABC + '"one', "no CSV text"),
    ],
)
def test_a_refusal_says_what_and_where(data, says):
    with pytest.raises(BrdfError, match=says):
        read_fit_table(data.encode(), "one")


def test_bytes_that_are_no_text_are_refused():
    with pytest.raises(BrdfError, match="no CSV text"):
        read_fit_table(b"name,\xff\xfe\n", "one")


def test_a_table_is_known_by_its_first_column():
    assert is_fit_table(ABC.encode())
    assert is_fit_table(sgd_table())
    # spreadsheets put a mark before the text
    marked = "\ufeff".encode() + (ABC + ABC_ROWS).encode()
    assert is_fit_table(marked)
    assert read_fit_table(marked, "two").ior == 1.1
    assert not is_fit_table(b'{"name": 1}')
