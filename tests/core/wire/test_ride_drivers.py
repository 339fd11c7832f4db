"""The driver of a ride is the one that was reported last before its end, whenever the ride is looked up."""

from socast.core.wire import rides
from socast.core.wire.messages import Ride
from socast.core.wire.rides import RideDrivers


def report(drivers, ride, driver, place, lane=0):
    drivers.observe(Ride("a", 0.0, ride, "start", driver), lane, place)


def test_report_after_the_end_of_a_ride_does_not_count():
    drivers = RideDrivers()
    report(drivers, "r", "first", 1)
    report(drivers, "r", "second", 5)
    report(drivers, "r", "too late", 9)
    assert drivers.find("a", "r", 5) == "second"
    drivers.settle()
    assert drivers.find("a", "r", 20) == "too late"
    assert drivers.find("a", None, 20) is None


def test_rides_are_forgotten_by_the_reports_before_their_end_only(monkeypatch):
    monkeypatch.setattr(rides, "DRIVERS", 0)
    monkeypatch.setattr(rides, "DRIVERS_PER_VEHICLE", 2)
    drivers = RideDrivers()
    for place, ride in enumerate("abcd"):
        report(drivers, ride, f"driver of {ride}", place)
    assert drivers.find_all("aa", "ac", [1, 2]) == ["driver of a", "driver of c"]
    assert drivers.find("a", "a", 3) is None


def test_state_keeps_reports_that_wait():
    drivers, other = RideDrivers(), RideDrivers()
    report(drivers, "r", "first", 1, lane=7)
    report(drivers, "r", "second", 5)
    drivers.settle(2)
    other.load(drivers.dump())
    assert other.dump() == drivers.dump()
    assert other.find("a", "r", 3) == "first"
    assert other.find("a", "r", 5) == "second"
