"""Write small files in the published formats of the data sets, and import them."""

import openpyxl
from typer.testing import CliRunner

from socast.tools.cli import application

VED_HEADER = (
    "DayNum,VehId,Trip,Timestamp(ms),Latitude[deg],Longitude[deg],Vehicle Speed[km/h],MAF[g/sec],Engine RPM[RPM],"
    "Absolute Load[%],OAT[DegC],Fuel Rate[L/hr],Air Conditioning Power[kW],Air Conditioning Power[Watts],"
    "Heater Power[Watts],HV Battery Current[A],HV Battery SOC[%],HV Battery Voltage[V],Short Term Fuel Trim Bank 1[%],"
    "Short Term Fuel Trim Bank 2[%],Long Term Fuel Trim Bank 1[%],Long Term Fuel Trim Bank 2[%]"
)
BMW_HEADER = (
    "Time [s];Velocity [km/h];Elevation [m];Battery Voltage [V];Battery Current [A];Battery Temperature [°C];SoC [%];"
    "max. SoC [%);Heating Power CAN [kW];Heating Power LIN [W];AirCon Power [kW];Ambient Temperature [°C];"
    "Coolant Volume Flow +500 [l/h];Temperature Vent right [°C] ;Temperature Vent right [°C]"
)
TWIZY_HEADER = (
    "Date,Time,Soc,Speed,Mode,LAT,LON,ALT,GpsSpeed,Temperature,Humidity,Weather,WindSpeedAv,Traffic,SpeedLimit"
)


def run_import(*arguments):
    """Run `socast import` with arguments of any type."""
    return CliRunner().invoke(application("import"), ["import", *map(str, arguments)])


def ved_row(ms, vehicle=455, trip=1, day=5.5, speed=36.0, current=-20.0, volts=360.0, engine="NaN", ac=100, heater=900):
    """Return one row of VED."""
    hv = f"{current},80.1,{volts}" if current is not None else "NaN,NaN,NaN"
    return (
        f"{day},{vehicle},{trip},{ms},42.24,-83.74,{speed},{engine},{engine},NaN,11.5,NaN,{ac / 1000},{ac},{heater},"
        f"{hv},NaN,NaN,NaN,NaN"
    )


def ved_file(path, rows=None):
    """Write a file of VED, by default one minute of car 455."""
    rows = [ved_row(ms) for ms in range(0, 60_001, 500)] if rows is None else rows
    path.write_text("\n".join([VED_HEADER, *rows]) + "\n")
    return path


def bmw_file(path, header=BMW_HEADER, n=601, tail="", row=None):
    """Write a file of the BMW i3, by default one minute."""
    row = row or "{t};36;500;390;-10;20;80;90;5.32;1200;-0.1;25;;9;10"
    lines = [header, *(row.format(t=round(i / 10, 1)) + tail for i in range(n))]
    path.write_bytes("\n".join(lines).encode("latin-1"))
    return path


def overview(folder, rows=(("TripA01", "2019-06-25_13-21-14"), ("TripB03", "2019_12_08_09-38-26")), header=None):
    """Write `Overview.xlsx` with the dates of trips."""
    book = openpyxl.Workbook()
    book.active.append(header or ["Trip", "Date", "Route/Area", "Weather"])
    for row in rows:
        book.active.append([*row, "Munich East", "sunny"])
    book.active.append([None])
    book.save(folder / "Overview.xlsx")


def twizy_file(path, n=61, date="04/22/2021", first="08:42:00", garbled=(), wind="2.5"):
    """Write a file of the Twizy, by default one minute."""
    second = sum(int(part) * scale for part, scale in zip(first.split(":"), (3600, 60, 1), strict=True))
    lines = [TWIZY_HEADER]
    for i in range(n):
        clock = f"{(second + i) // 3600:02d}:{(second + i) // 60 % 60:02d}:{(second + i) % 60:02d}"
        day = "90/02/2032" if i in garbled else date
        fix = "0.000000,0.000000" if i == 30 else "33.986225,-6.725523"
        lines.append(f"{day},{clock},87.5,36.0,D,{fix},140.0,30.0,20.0,60.0,Clouds,{wind},0,40.0")
    path.write_text("\n".join(lines) + "\n")
    return path


def write_good_file(folder, name):
    """Write one good file of a data set and return its path."""
    if name == "ved":
        return ved_file(folder / "week.csv")
    if name == "bmw-i3":
        overview(folder)
        return bmw_file(folder / "TripA01.csv")
    return twizy_file(folder / "T3.csv")
