"""Test that times in text are read in the forms in which phones and programs of many languages write them."""

import numpy as np
import pyarrow as pa
import pytest

from socast.tools.importers.table.text_times import list_forms, parse_times
from socast.tools.importers.table.time_words import describe_doubt, find_month, find_offset

MONTHS = {
    "English": "Jan Feb Mar Apr May Jun Jul Aug Sept Oct Nov Dec",
    "German": "Jan. Feb. März Apr. Mai Juni Juli Aug. Sept. Okt. Nov. Dez.",
    "Austrian": "Jän. Feb. Mär Apr Mai Jun Jul Aug Sep Okt Nov Dez",
    "French": "janv. févr. mars avr. mai juin juil. août sept. oct. nov. déc.",
    "Spanish": "ene. feb. mar. abr. may. jun. jul. ago. sept. oct. nov. dic.",
    "Italian": "gen feb mar apr mag giu lug ago set ott nov dic",
    "Portuguese": "jan. fev. mar. abr. mai. jun. jul. ago. set. out. nov. dez.",
    "Dutch": "jan. feb. mrt. apr. mei jun. jul. aug. sep. okt. nov. dec.",
    "Polish": "sty lut mar kwi maj cze lip sie wrz paź lis gru",
    "Swedish": "jan. feb. mars apr. maj juni juli aug. sep. okt. nov. dec.",
    "Danish": "jan. feb. mar. apr. maj jun. jul. aug. sep. okt. nov. dec.",
    "Norwegian": "jan. feb. mars apr. mai juni juli aug. sep. okt. nov. des.",
    "Finnish": "tammik. helmik. maalisk. huhtik. toukok. kesäk. heinäk. elok. syysk. lokak. marrask. jouluk.",
    "Czech": "led úno bře dub kvě čvn čvc srp zář říj lis pro",
    "Slovak": "jan feb mar apr máj jún júl aug sep okt nov dec",
    "Hungarian": "jan. febr. márc. ápr. máj. jún. júl. aug. szept. okt. nov. dec.",
    "Romanian": "ian. feb. mar. apr. mai iun. iul. aug. sept. oct. nov. dec.",
    "Turkish": "Oca Şub Mar Nis May Haz Tem Ağu Eyl Eki Kas Ara",
    "Russian": "янв. февр. марта апр. мая июня июля авг. сент. окт. нояб. дек.",
    "Ukrainian": "січ. лют. бер. квіт. трав. черв. лип. серп. вер. жовт. лист. груд.",
    "Greek": "Ιαν Φεβ Μαρ Απρ Μαΐ Ιουν Ιουλ Αυγ Σεπ Οκτ Νοε Δεκ",
    "Catalan": "gen. febr. març abr. maig juny jul. ag. set. oct. nov. des.",
    "Estonian": "jaan veebr märts apr mai juuni juuli aug sept okt nov dets",
    "Lithuanian": "saus. vas. kov. bal. geg. birž. liep. rugp. rugs. spal. lapkr. gruod.",
}


@pytest.mark.parametrize("language", MONTHS)
def test_months_are_read_in_any_case_and_with_or_without_points(language):
    for number, name in enumerate(MONTHS[language].split(), start=1):
        for spelled in (name, name.upper(), name.capitalize(), name.strip(".")):
            assert find_month(spelled) == number, spelled


def test_names_of_two_months_are_told():
    assert describe_doubt("lis") == "November in Polish and Czech, October in Croatian"
    assert not describe_doubt("listy")


FORMS = [
    ("05-ago.-2024 14:03:00.000", None),
    ("05-AOÛT-2024 14:03:00", None),
    ("5 août 2024 14:03:00", None),
    ("5. August 2024 14:03", None),
    ("lun. 05 ago. 2024 14:03:00", None),
    ("mar. 05 août 2024 14:03:00", None),
    ("lundi 5 août 2024 à 14:03:00", None),
    ("5 de agosto de 2024 2:03:00 p. m.", None),
    ("August 5th, 2024 2:03:00 PM", None),
    ("2024-Aug-05 14:03:00", None),
    ("2024年8月5日 14:03:00", None),
    ("05.авг.2024 14:03:00", None),
    ("20240805T140300", None),
    ("2024/8/5 14:03", None),
    ("14:03:00 5 Aug 2024", None),
    ("5. kesäk. 2024 klo 14:03:00".replace("kesäk", "elok"), None),
    ("Mon Aug 05 14:03:00 GMT+02:00 2024", 7200),
    ("Mon Aug 05 14:03:00 CEST 2024", 7200),
    ("lun. août 05 14:03:00 EST 2024", -18000),
    ("Mon Aug 05 2024 14:03:00 GMT+0200 (Central European Summer Time)", 7200),
    ("05 Aug 2024 14:03:00 -0330", -12600),
    ("2024-08-05 14:03:00 UTC", 0),
]


@pytest.mark.parametrize(("text", "offset"), FORMS, ids=[text for text, _ in FORMS])
def test_form_is_derived_from_the_text_and_reads_it(text, offset):
    forms = list_forms([text])
    found = {form: parse_times(pa.array([text]), form) for form in forms}
    assert "2024-08-05T14:03:00.000000" in {str(each.stamps[0]) for each in found.values()}
    offsets = {each.offsets[0] for each in found.values()}
    assert offsets == {offset} if offset is not None else np.isnan(list(offsets)).all()


def test_numbers_of_day_and_month_have_two_forms():
    assert list_forms(["06/05/2024 14:03"]) == ["%d/%m/%Y %H:%M", "%m/%d/%Y %H:%M"]


@pytest.mark.parametrize(
    "text", ["31-Feb-2024 10:00:00", "05-xyz-2024 10:00:00", "05-Aug-2024 25:00:00", "05-Aug-2024"]
)
def test_what_is_no_such_time_is_unknown(text):
    assert np.isnat(parse_times(pa.array([text]), "%d-%b-%Y %H:%M:%S").stamps[0])


def test_fraction_of_zero_may_be_left_out():
    texts = pa.array(["05-08-2024 14:03:00", "05-08-2024 14:03:00.25"])
    stamps = parse_times(texts, "%d-%m-%Y %H:%M:%S.%f").stamps
    assert stamps.astype(str).tolist() == ["2024-08-05T14:03:00.000000", "2024-08-05T14:03:00.250000"]


def test_year_at_the_end_is_no_offset():
    parsed = parse_times(pa.array(["14:03 05-08-2024"]), "%H:%M %d-%m-%Y")
    assert np.isnan(parsed.offsets[0])


@pytest.mark.parametrize("text", ["CST", "IST", "BST", "+25:00", "Monday"])
def test_abbreviation_of_several_zones_gives_no_offset(text):
    assert find_offset(text) is None
