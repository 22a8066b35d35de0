"""The energy and mass ledger: where every joule and every kilogram went, summed exactly.

Each term is summed as integers in units of a fixed quantum, so the ledger is the same, bit for bit,
on any number of ranks. Terms are cumulative from the start of the run, except the energies of the present state.
"""

from __future__ import annotations

from f2s_hpc import mpi

ENERGY_TERMS = {
    "brought_in": "kinetic energy of the material put in",
    "kinetic": "kinetic energy now",
    "elastic": "elastic energy now, of shape and of volume",
    "plastic_work": "plastic work",
    "shock_viscosity": "work of the shock viscosity",
    "compression": "work of the pressure that is kept as internal energy (Mie-Grueneisen only)",
    "hourglass": "work of the hourglass control",
    "light_nodes": "kinetic energy taken from light nodes: exchange, mass floor, speed cap",
    "remap_kinetic": "kinetic energy lost in the momentum remap, summed node by node",
    "remap_elastic": "elastic energy lost in the stress remap and the closure, less what sealed traces of void store",
    "half_kicks": "work of half kicks around a remap, which changes the forces, and of steps that change, that no cell "
                  "gives or receives: dt^2 F^2 / 8m, node by node",
    "closing": "work of the pressure of cells that close within a step over the void that they had left",
    "time_step": "work of the forces on the nodes less what the cells received: error of the explicit step",
    "put_to_sleep": "kinetic energy of what was put to sleep (numerics.sleeping_depth)",
    "through_faces": "kinetic energy that left through open faces, and what absorbing ones took",
    "remainder": "what no term explains",
    "heat": "heat from plastic work, shock viscosity and numerical losses (contained in those, no term of the balance)",
    "returned_heat": "share of that heat that comes from hourglass control, remap and light nodes",
}

_COUNTS = ("brought_in", "work", "plastic_work", "shock_viscosity", "hourglass_power", "heat", "returned", "exchanged",
           "exchange_kept", "lost", "capped", "withheld", "half_kicks", "half_kicks_kept",
           "closing", "kinetic_before", "kinetic_after", "elastic_before", "elastic_after", "through_faces",
           "put_to_sleep", "mass_left", "mass_lent", "mass_capped", "mass_painted", "nodes_capped", "compression")


class Ledger:
    """Cumulative sums of this rank, in quanta; :meth:`totals` adds the ranks."""

    def __init__(self, energy_quantum: float) -> None:
        self.energy_quantum = energy_quantum
        self.counts: dict[str, int] = dict.fromkeys(_COUNTS, 0)

    def add(self, name: str, quanta: int) -> None:
        """Add ``quanta`` to a count of this rank."""
        self.counts[name] += int(quanta)

    def add_power(self, name: str, quanta: int, dt: float) -> None:
        """Add a power, summed in units of ``energy_quantum`` per nanosecond, over the step ``dt`` (s)."""
        # an integer product keeps the sum independent of how many ranks share it
        self.counts[name] += int(quanta) * round(dt * 1e9 * 2**40)

    def totals(self) -> dict[str, int]:
        """Return the counts of all ranks together (collective)."""
        parts = mpi.all_gather(self.counts)
        return {name: sum(part[name] for part in parts) for name in _COUNTS}

    def restore(self, totals: dict[str, int]) -> None:
        """Continue from the totals of a checkpoint: rank 0 takes them, the others start at zero."""
        # (a count that is younger than the checkpoint was zero)
        self.counts = {name: int(totals.get(name, 0)) if mpi.is_root() else 0 for name in _COUNTS}

    def energy(self, totals: dict[str, int], kinetic_now: int, elastic_now: int) -> dict[str, float]:
        """Return the energy balance in joules (terms of :data:`ENERGY_TERMS`)."""
        joule = self.energy_quantum
        power = joule / 2**40
        light = totals["exchanged"] + totals["capped"] + totals["withheld"]
        remap_kinetic = totals["lost"] - totals["exchange_kept"] - totals["half_kicks_kept"]
        remap_elastic = totals["elastic_after"] - totals["elastic_before"] - elastic_now
        terms = {
            "brought_in": totals["brought_in"] * joule,
            "kinetic": kinetic_now * joule,
            "elastic": elastic_now * joule,
            "plastic_work": totals["plastic_work"] * joule,
            "shock_viscosity": totals["shock_viscosity"] * joule,
            "compression": totals["compression"] * joule,
            "hourglass": totals["hourglass_power"] * power,
            "light_nodes": light * joule,
            "remap_kinetic": remap_kinetic * joule,
            "remap_elastic": remap_elastic * joule,
            "half_kicks": totals["half_kicks"] * joule,
            "closing": totals["closing"] * joule,
            "put_to_sleep": totals["put_to_sleep"] * joule,
            "through_faces": totals["through_faces"] * joule,
        }
        received = (totals["elastic_after"] - totals["elastic_before"] + totals["plastic_work"]
                    + totals["shock_viscosity"] + totals["compression"])
        terms["time_step"] = -(totals["work"] + received + totals["half_kicks"] + totals["closing"]) * joule - terms[
            "hourglass"]
        spent = sum(value for name, value in terms.items() if name != "brought_in")
        terms["remainder"] = terms["brought_in"] - spent
        terms["heat"] = totals["heat"] * joule
        terms["returned_heat"] = totals["returned"] * joule
        return terms
