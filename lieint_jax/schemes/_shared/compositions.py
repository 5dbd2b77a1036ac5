"""Coefficients of compositions Ψ_{γ₁Δt} ∘ … ∘ Ψ_{γ_sΔt} of a symmetric second-order step, published and new ones.

They are strings of forty digits, more than a float holds. The published ones were refined from the 26 printed digits by
Newton's method on the order conditions (none changed by more than 5e-27), and `tests/schemes/test_compose.py` checks
every condition again, in the free associative algebra.
"""

from __future__ import annotations

from typing import NamedTuple


class Method(NamedTuple):
    """A composition.

    Attributes:
        order: the order of accuracy, for a base step of order 2.
        values: the distinct γ, first to middle of the palindrome, or with `counts` in any order.
        counts: the number of uses of each value, for steps that commute; empty for a palindrome.
        source: the publication.
    """

    order: int
    values: tuple[str, ...]
    counts: tuple[int, ...]
    source: str

    @property
    def gammas(self) -> tuple[float, ...]:
        """γ₁ … γ_s, a palindrome. With commuting steps equal values are spread evenly: partial sums stay small."""
        values = [float(value) for value in self.values]
        if not self.counts:
            return (*values, *values[-2::-1])
        places = sorted(
            ((i + 0.5) / count, value) for value, count in zip(values, self.counts, strict=True) for i in range(count)
        )
        return tuple(value for _, value in places)

    @classmethod
    def of(cls, order: int, source: str, values: str, counts: tuple[int, ...] = ()) -> Method:
        """The composition of values that are separated by spaces and lines."""
        return cls(order, tuple(values.split()), counts, source)


METHODS: dict[str, Method] = {
    "triple_jump": Method.of(
        4,
        "Creutz & Gocksch 1989; Forest & Ruth 1990; Yoshida 1990",
        """
        1.351207191959657634047687808971460826922 -1.702414383919315268095375617942921653844
        """,
    ),
    "suzuki": Method.of(
        4,
        "Suzuki 1990, Phys. Lett. A 146",
        """
        0.414490771794375737142354062860761495711775 0.414490771794375737142354062860761495711775
        -0.657963087177502948569416251443045982847098
        """,
    ),
    "yoshida_6": Method.of(
        6,
        "Yoshida 1990, Phys. Lett. A 150, solution A",
        """
        0.784513610477557263819497633866349875776824 0.235573213359358133684793182978534601686468
        -1.17767998417887100694641568096431573463927 1.31518632068391121888424972823886251435195
        """,
    ),
    "kahan_li_6": Method.of(
        6,
        "Kahan & Li 1997, Math. Comp. 66, s9odr6a",
        """
        0.392161444007314139279250557422671403804934 0.332599136789359438599748637500049646881587
        -0.706246172557639359809964819549256459395511 0.0822135962935508002314904481020563311032939
        0.798543990934829963398950353048958155211391
        """,
    ),
    "suzuki_umeno_8": Method.of(
        8,
        "Suzuki & Umeno 1993; McLachlan 1995",
        """
        0.741670364350612953448227801783806315603537 -0.409100825800031593997300095893563417309918
        0.190754710296238379953876256450371662735461 -0.573862471116082266656387726635535742159509
        0.299064181303655923844463540688602988225823 0.334624918245298183784957979882182288633692
        0.315293092396766596632056663811002430994081 -0.796887939352916354019788840173733053446332
        """,
    ),
    "kahan_li_8": Method.of(
        8,
        "Kahan & Li 1997, Math. Comp. 66, s17odr8a",
        """
        0.130202483088890080878817632096700522357247 0.561162981775108384561964407700150567266159
        -0.389474962644847286408078598235248388836068 0.158841906555155600896210745707152481412148
        -0.395903894133237577336231539347938936026771 0.184539640978315707091832541533375462818987
        0.258374387686322047293979109994939471813076 0.295011723609310298870966240218228112976543
        -0.605508533830034511698921079334718587562643
        """,
    ),
    "sofroniou_spaletta_10": Method.of(
        10,
        "Sofroniou & Spaletta 2005, Optim. Methods Softw. 20",
        """
        0.0787957225216864192639076793383782352877653 0.313096103415108527764812471919375119427788
        0.0279183832350780661095202732646229631648935 -0.229592841593907094151213396801772333759619
        0.130962061077164863174656859293939635912993 -0.269733405654510714344609732216317792089151
        0.0749733431558914356661371056387287990291454 0.111993423999810204889575080737386917384281
        0.366133449546226751193148123537947805939005 -0.399105630136035897878629810584101969653898
        0.103087398527471077315802769991778382274162 0.411430873955890237820704118977676163371669
        -0.00486636058313526176219565930742547587096462 -0.392033353708639906448081936430529864761924
        0.0519425029624496470371829049273376385168948 0.0506650907599244963358743424008435193510213
        0.0496743706397298790545688003948408097700571 0.0493177357595945379176800098345828934117586
        """,
    ),
    "commuting_4": Method.of(
        4,
        "this package: the 2 power sums of commuting steps",
        """
        0.166666666666666666666666666666666666666667 -0.333333333333333333333333333333333333333333
        """,
        (8, 1),
    ),
    "commuting_6": Method.of(
        6,
        "this package: the 3 power sums of commuting steps",
        """
        0.129994945203667320985059300135055407766907 -0.348912781680266350789791672428873906490663
        0.397876111323859491728990343507193735312255
        """,
        (10, 2, 1),
    ),
    "commuting_8": Method.of(
        8,
        "this package: the 4 power sums of commuting steps",
        """
        0.0881389577857181174961516321872528183608481 -0.286814408201872719768330984112075264131943
        0.366587151046024574793981638211277237095442 -0.393490894688357354997424158819943402978872
        """,
        (14, 2, 2, 1),
    ),
    "commuting_10": Method.of(
        10,
        "this package: the 5 power sums of commuting steps",
        """
        0.0758293695425890165158331194342723948578267 -0.416466913939486504259593238076581279827266
        0.360007026317447301288265972210737646559922 -0.267985019810826729442362036000295114763093
        0.435619902184307600574048692783919178335647
        """,
        (16, 2, 2, 2, 1),
    ),
}
