"""Colors of the stretches of a verdict, by kind, in pages and recordings."""

from scanchain.verdict import Kind

STRETCH_COLORS = {
    Kind.DEGENERATE: "#d98200",
    Kind.LOST: "#d6453d",
    Kind.CONTRADICTED: "#a55bd6",
    Kind.WHEELS: "#d6308f",
    Kind.SCANS_SLIP: "#be123c",
    Kind.WHEELS_SLIP: "#64748b",
    Kind.ACCELERATION: "#8a1c1c",
    Kind.LOOPS: "#0f9bb5",
    Kind.OVERLAP: "#b7791f",
    Kind.DISCONNECTED: "#6b7280",
    Kind.COPIES: "#4d7c0f",
}
