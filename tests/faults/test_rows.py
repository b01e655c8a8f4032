"""Index: what can go wrong, row by row, and the tests that hold the required behaviour.

`ROWS` names for each fault what is required of the rig and the tests that show it. Where the row is about processes the
tests run over real ones, and what they assert is what the simulated supply's own output did.
"""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1]

Row = tuple[str, str, list[str]]
ROWS: dict[int, Row] = {
    1: (
        "the engine is killed",
        "the guard commands the output off and records that",
        [
            "faults/test_processes.py::test_engine_killed",
            "faults/test_kills.py::test_engine_killed_at_random_instants",
            "faults/test_serial_supply.py::test_killed",
        ],
    ),
    2: (
        "SIGTERM, SIGHUP, Ctrl-C once and often, the terminal gone",
        "ramped down, at once when hastened; the way to the safe state is never skipped",
        [
            "faults/test_terminal.py::test_ctrl_c_ramps_down",
            "faults/test_terminal.py::test_ctrl_c_twelve_times_hastens_and_skips_nothing",
            "faults/test_terminal.py::test_the_terminal_is_closed",
            "faults/test_terminal.py::test_a_signal_from_outside",
            "faults/test_processes.py::test_guard_ignores_signals_that_end_programs",
        ],
    ),
    3: (
        "the engine hangs: stopped, or in a loop that never comes back",
        "the heartbeat's deadline takes the output off",
        [
            "faults/test_processes.py::test_engine_hung",
            "faults/test_processes.py::test_engine_that_was_stopped_and_goes_on_gets_no_voltage_any_more",
            "rig/safety/test_heartbeat.py::test_a_silent_engine_is_left_no_voltage_after_the_deadline_and_not_before",
            "rig/safety/test_heartbeat.py::test_a_heartbeat_that_cannot_be_believed_takes_the_output_off_at_once",
        ],
    ),
    4: (
        "the guard is killed, or hangs",
        "the engine stops, opens the link itself and commands the output off",
        [
            "faults/test_processes.py::test_guard_killed",
            "faults/test_processes.py::test_guard_that_is_stopped_is_ended_and_replaced_by_the_engine",
            "rig/safety/test_stopped.py::test_only_a_process_that_was_stopped_counts_as_stopped",
            "faults/test_hanging.py::test_taking_over_needs_no_lock_no_file_and_no_descriptor",
            "faults/test_serial_supply.py::test_killed",
        ],
    ),
    5: (
        "both are killed; the supply's bus is pulled; the computer is suspended",
        "the hardware's job, said plainly; NOT SAFE; off after waking up",
        [
            "faults/test_processes.py::test_engine_and_guard_killed_leave_the_voltage_to_the_hardware",
            "faults/test_processes.py::test_a_bus_that_is_pulled_with_voltage_on_ends_the_run_as_not_safe",
            "faults/test_host.py::test_a_computer_that_was_suspended_with_voltage_on_takes_it_off",
        ],
    ),
    6: (
        "the supply ignores off",
        "NOT SAFE, never safe; told again",
        [
            "faults/test_processes.py::test_engine_killed_with_a_supply_that_does_not_obey_is_called_not_safe",
            "faults/test_switches.py::test_the_run_ends_as_required",
            "faults/test_run_ends_safe.py::test_a_supply_that_does_not_hear_the_first_off_is_told_again",
        ],
    ),
    7: (
        "over-current, arc, sag",
        "off within two samples, latched",
        [
            "faults/test_run_ends_safe.py::test_a_breakdown_takes_the_output_off_at_once",
            "faults/test_limits.py::test_a_current_that_charging_does_not_explain_is_a_breakdown_within_two_samples",
            "faults/test_limits.py::test_a_sagging_output_is_taken_off_within_two_samples",
            "faults/test_other_instruments.py::test_without_a_current_monitor_a_failing_film_shows_in_the_voltage",
            "faults/test_switches.py::test_the_run_ends_as_required",
        ],
    ),
    8: (
        "the field exceeds its limit by motion alone",
        "refused before voltage or displacement change; off when it is measured",
        [
            "faults/test_limits.py::test_a_move_into_the_field_limit_is_refused_before_the_stage_moves",
            "faults/test_limits.py::test_a_voltage_into_the_field_limit_is_refused_before_the_output_rises",
            "faults/test_limits.py::test_a_film_that_is_moved_by_somebody_else_is_cut_off_at_its_field_limit",
            "rig/safety/test_heartbeat.py::test_a_move_is_asked_for_and_a_voltage_is_held_against_where_it_leads",
            "rig/safety/test_heartbeat.py::test_a_disk_that_moves_where_the_field_is_too_high_takes_the_output_off",
            "rig/safety/test_guard.py::test_a_voltage_that_the_flat_film_bears_is_refused_on_the_stretched_one",
        ],
    ),
    9: (
        "the force exceeds its limit; zeros are taken again and again",
        "the limit holds against the stored zero",
        [
            "faults/test_limits.py::test_no_row_of_zero_steps_carries_the_force_limit_away",
            "faults/test_limits.py::test_a_zero_far_from_the_stored_one_is_refused_though_its_reading_is_small",
            "faults/test_run_ends_safe.py::test_a_film_stiffer_than_believed_stops_at_the_force_limit",
            "faults/test_run_ends_safe.py::test_a_sensor_far_off_at_zero_is_refused",
        ],
    ),
    10: (
        "a sensor is silent, frozen, saturated, without a value",
        "the stage stops and the voltage goes",
        [
            "faults/test_limits.py::"
            "test_without_fresh_data_the_stage_stops_within_two_periods_and_the_time_out_and_the_voltage_ramps_down",
            "faults/test_switches.py::test_the_run_ends_as_required",
            "rig/safety/test_heartbeat.py::test_a_loop_that_beats_on_old_data_is_ramped_down",
        ],
    ),
    11: (
        "torn, merged, doubled, late replies; alerts between",
        "dropped and counted, never taken for another's",
        [
            "faults/test_switches.py::test_a_little_of_everything_is_tolerated",
            "faults/test_matrix.py::test_every_switch_is_met_as_required",
            "faults/test_other_instruments.py::test_lines_doubled_torn_and_late_change_nothing",
            "faults/test_other_instruments.py::test_damaged_answers_never_raise_the_voltage",
        ],
    ),
    12: (
        "a port vanishes at any call",
        "one kind of error, safe, never armed again by itself",
        [
            "drivers/links/test_serial_link.py::test_every_way_to_vanish_at_every_call",
            "drivers/links/test_can_link.py::test_slcan_that_vanishes_is_lost",
            "faults/test_one_way.py::test_the_off_goes_out_on_a_line_that_cannot_be_read",
            "faults/test_switches.py::test_the_run_ends_as_required",
        ],
    ),
    13: (
        "a device restarts in the middle of a move",
        "its position is unknown: it is not moved again until homed",
        [
            "faults/test_stage_and_laser.py::test_stage_that_restarts_in_the_middle_of_a_move_is_refused_until_homed",
            "faults/test_switches.py::test_the_run_ends_as_required",
        ],
    ),
    14: (
        "a port comes back under another name; instruments are swapped",
        "known by serial number, else refused",
        [
            "faults/test_run_ends_safe.py::test_a_supply_that_vanishes_and_comes_back_is_switched_off",
            "faults/test_run_ends_safe.py::"
            "test_an_instrument_with_another_serial_number_is_refused_before_anything_moves",
        ],
    ),
    15: (
        "the CAN controller goes bus-off; python-can fails in its own way",
        "the loss of the device; there is no thread that could die unseen",
        [
            "drivers/links/test_can_link.py::test_error_frames_are_counted_and_bus_off_is_a_loss",
            "drivers/links/test_can_link.py::test_a_controller_that_has_gone_bus_off_is_a_loss_also_without_an_error_frame",
            "drivers/links/test_can_link.py::test_a_backend_that_fails_is_a_loss",
        ],
    ),
    16: (
        "the calendar is set by an hour",
        "durations are unaffected, and it is told",
        ["faults/test_host.py::test_a_calendar_that_is_set_changes_no_duration_and_is_told"],
    ),
    17: (
        "the disk is full, or the log cannot be written",
        "the run ends safely and the log stays readable",
        [
            "faults/test_run_ends_safe.py::test_a_full_disk_ends_the_run_and_leaves_a_readable_log",
            "faults/test_run_ends_safe.py::test_a_disk_that_is_nearly_full_ends_the_run_with_a_finished_log",
            "faults/test_run_ends_safe.py::test_a_log_that_fails_on_the_way_to_the_safe_state_stops_nothing",
        ],
    ),
    18: (
        "the power is cut",
        "what had been synced is there, and nothing wrong",
        ["rig/log/test_power_cut.py::test_power_cuts"],
    ),
    19: (
        "a log is truncated, or has flipped bits",
        "gaps are listed and flips detected",
        ["rig/log/test_damage.py::test_cut_anywhere", "rig/log/test_damage.py::test_flip_anywhere"],
    ),
    20: (
        "a hostile log or file of settings",
        "one error of the family, in bounded time and memory; nothing is run",
        [
            "rig/log/test_damage.py::test_hostile",
            "rig/log/test_damage.py::test_names_from_a_log_are_data",
            "rig/scene/test_config_errors.py::test_a_bad_scene_names_file_key_value_and_what_is_allowed",
        ],
    ),
    21: (
        "a certificate is out of date, or another instrument's",
        "told in the log, or refused",
        [
            "rig/base/test_certificates.py::test_expired_not_yet_valid_and_mismatched",
            "faults/test_run_ends_safe.py::test_a_certificate_of_another_sensor_is_told_in_the_log",
        ],
    ),
    22: (
        "a second run, or another program, on the same port",
        "refused; the first one is not disturbed",
        [
            "faults/test_processes.py::test_a_second_run_on_the_same_ports_is_refused_and_disturbs_nothing",
            "drivers/links/test_serial_link.py::test_lock_of_another_process_holds_until_it_is_killed",
            "drivers/links/test_own_directory.py::test_nothing_is_made_in_the_directory_of_another_user",
            "drivers/links/test_own_directory.py::test_a_port_without_a_place_for_its_lock_says_what_to_set",
        ],
    ),
    23: (
        "the supply is found live at the start",
        "reported, nothing changed, a ramp down offered",
        [
            "faults/test_run_ends_safe.py::test_a_supply_found_live_is_reported_and_left_alone",
            "faults/test_run_control.py::test_a_supply_found_live_is_taken_down_when_the_operator_chooses",
            "faults/test_run_control.py::"
            "test_a_supply_found_live_is_left_alone_while_the_operator_thinks_and_when_he_stops",
        ],
    ),
    24: (
        "a port that never says that it has sent; an adapter that takes nothing",
        "no call in the loops waits; lost and said within a second, NOT SAFE within five, signals work",
        [
            "faults/test_hanging.py::test_nothing_waits_for_a_port_to_send",
            "faults/test_hanging.py::test_neither_loop_makes_a_call_that_could_wait",
            "faults/test_hanging.py::test_an_adapter_that_takes_nothing_is_lost_and_said",
            "faults/test_hanging.py::test_signals_work_while_the_adapter_takes_nothing",
            "drivers/links/test_serial_link.py::test_stalled_peer_is_told_within_a_second_instead_of_waited_for",
        ],
    ),
    25: (
        "an adapter is pulled, and back under its name",
        "found again by name and serial number, off within a second of its return",
        [
            "faults/test_processes.py::"
            "test_an_adapter_that_is_pulled_and_comes_back_is_found_again_and_the_output_taken_off",
            "faults/test_processes.py::"
            "test_a_guard_killed_while_the_adapter_is_out_leaves_the_engine_to_take_the_output_off",
            "drivers/links/test_serial_link.py::test_a_port_that_comes_back_under_its_name_is_opened_again",
            "drivers/links/test_serial_link.py::test_another_adapter_under_the_same_name_is_left_alone",
        ],
    ),
    26: (
        "an output that creeps, jumps or stays, and says that it ramps",
        "held against the commanded ramp at all times",
        [
            "faults/test_hanging.py::test_an_output_that_creeps_and_says_ramping_is_taken_off",
            "rig/safety/test_guard.py::test_an_output_that_creeps_is_a_fault_whatever_the_supply_says_of_itself",
            "rig/safety/test_guard.py::"
            "test_an_output_that_jumps_past_its_ramp_is_a_fault_though_it_is_below_its_set_point",
            "rig/safety/test_guard.py::test_a_ramp_down_that_does_not_come_down_is_not_waited_for",
            "rig/safety/test_commanded.py::test_an_output_that_follows_its_ramps_stays_inside",
        ],
    ),
    27: (
        "a run ends in whatever way with an output that was not measured off",
        "exit code 4, status and last line NOT SAFE, and never otherwise",
        [
            "faults/test_exit_paths.py::test_not_safe_is_never_hidden",
            "faults/test_exit_paths.py::test_and_never_said_otherwise",
            "rig/safety/test_guard.py::test_an_output_that_is_called_off_and_drives_a_current_is_not_off",
        ],
    ),
    28: (
        "real ports taken for simulated ones",
        "--yes never arms them; SIMULATED or REAL PORTS first; no other bench on resuming or in one fit",
        [
            "rig/run/test_what_is_real.py::test_only_pseudo_terminals_that_the_simulation_printed_are_simulated",
            "rig/run/test_what_is_real.py::test_a_list_of_ports_whose_server_has_ended_is_of_real_ports",
            "rig/run/test_what_is_real.py::test_yes_never_arms_real_ports",
            "rig/run/test_what_is_real.py::test_a_run_is_not_taken_up_on_another_bench",
            "rig/run/test_what_is_real.py::test_logs_of_hardware_and_simulated_ones_are_not_fitted_together",
        ],
    ),
    29: (
        "the log is deleted, its writer hangs, the terminal takes nothing, the bus is full",
        "safe within a second, the log saved, no process left behind; nothing waits",
        [
            "faults/test_hanging.py::test_a_log_that_is_deleted_ends_the_run_at_once_and_is_saved",
            "faults/test_hanging.py::test_a_writer_that_hangs_ends_the_run_and_is_not_left_behind",
            "faults/test_hanging.py::test_a_pipe_that_nobody_reads_holds_up_neither_the_run_nor_its_end",
            "faults/test_hanging.py::test_a_bus_full_of_other_frames_delays_nothing",
            "rig/cli/test_streams.py::test_no_port_gets_the_number_of_a_closed_stream",
        ],
    ),
    30: (
        "settings of stage, amplifier and supply that a run changes",
        "own axis and own bits only; given back as found, also after a kill",
        [
            "faults/test_stage_and_laser.py::test_the_stage_gets_back_what_it_lent_and_other_axes_are_left_alone",
            "faults/test_stage_and_laser.py::test_a_knob_that_was_disabled_stays_so",
            "faults/test_stage_and_laser.py::test_what_a_killed_run_left_is_given_back_by_the_next_one",
            "faults/test_processes.py::test_the_stage_gets_back_after_a_kill_what_it_had_lent",
            "faults/test_lent_settings.py::test_the_amplifier_gets_back_rate_frame_type_and_stream",
            "faults/test_lent_settings.py::"
            "test_the_next_run_gives_back_what_a_killed_one_had_found_unless_it_was_set_since",
            "faults/test_lent_settings.py::test_the_supply_gets_its_modes_back_and_stays_at_zero_volts",
            "faults/test_load_cell_and_supply.py::test_a_run_arms_the_supplys_own_trip_and_gives_everything_back",
            "drivers/instruments/test_iseg_edcp.py::"
            "test_bits_of_the_control_register_that_are_somebody_elses_stay_and_confuse_nobody",
        ],
    ),
    31: (
        "two stages with one address",
        "refused before anything moves",
        ["faults/test_stage_and_laser.py::test_two_stages_with_one_address_are_refused_before_anything_moves"],
    ),
    32: (
        "a load cell that is frozen but for its noise, a torn film",
        "a force that does not follow the model while the film moves ends the run",
        [
            "faults/test_limits.py::test_a_force_that_does_not_follow_the_film_ends_the_run",
            "faults/test_limits.py::test_a_film_four_times_softer_or_stiffer_than_believed_is_still_a_film",
        ],
    ),
    33: (
        "program and guard both stopped while the film breaks down",
        "the supply's own trip, armed with it, takes the output off",
        ["faults/test_load_cell_and_supply.py::test_armed_the_supply_trips_by_itself_with_nobody_there_to_see_it"],
    ),
    34: (
        "a computer that would go to sleep with voltage on",
        "kept awake where the system can; said where it cannot; nothing waits for that",
        [
            "rig/operator/test_awake.py::test_the_lock_is_held_inside_and_let_go_after",
            "rig/operator/test_awake.py::test_one_that_hangs_holds_nobody_up",
            "rig/operator/test_awake.py::test_where_there_is_no_lock_it_is_said_and_the_run_goes_on",
        ],
    ),
    35: (
        "limits and thresholds that cannot be meant",
        "what run refuses, check refuses",
        [
            "rig/run/test_rehearse.py::test_a_threshold_that_would_not_be_felt_in_time",
            "rig/run/test_rehearse.py::test_a_limit_that_protects_nothing_needs_to_be_accepted_by_name",
            "rig/cli/test_mistakes.py::test_what_is_meant_can_be_accepted_by_name",
        ],
    ),
    36: (
        "a supply that says off and measures 0 V while its output stays on",
        "with a second reading NOT SAFE, exit code 4, told again until both show off; without one, said at arming",
        [
            "faults/test_second_reading.py::test_a_supply_that_lies_is_not_safe_with_one",
            "faults/test_second_reading.py::test_a_supply_that_lies_about_its_voltage_only_ends_the_run_by_name",
            "faults/test_second_reading.py::test_an_output_that_only_the_second_reading_shows_is_not_armed",
            "faults/test_second_reading.py::test_what_cannot_be_detected_is_said_at_arming",
            "faults/test_second_reading_ports.py::"
            "test_a_supply_that_lies_ends_not_safe_and_the_guard_goes_on_until_both_show_off",
        ],
    ),
    37: (
        "the second reading fails, or its reader dies",
        "off is commanded all the same; nobody calls it safe without a fresh reading; the guard reads on",
        [
            "faults/test_second_reading.py::test_a_second_reading_that_fails_ends_the_run_and_prevents_no_off",
            "faults/test_second_reading.py::test_off_needs_two_fresh_good_readings_after_the_command",
            "faults/test_second_reading_ports.py::"
            "test_a_second_reading_that_dies_prevents_no_off_but_nobody_calls_it_safe",
            "faults/test_second_reading_ports.py::test_an_engine_that_is_killed_leaves_the_monitor_to_the_guard",
            "faults/test_second_reading_ports.py::test_a_guard_that_is_killed_leaves_both_to_the_engine",
        ],
    ),
}


@cache
def names_in(path: str) -> frozenset[str]:
    tree = ast.parse((TESTS / path).read_text(encoding="utf-8"))
    return frozenset(node.name for node in tree.body if isinstance(node, ast.FunctionDef))


def test_the_rows_are_numbered() -> None:
    assert sorted(ROWS) == list(range(1, len(ROWS) + 1))


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row}: {ROWS[row][0]}")
def test_every_row_has_its_tests(row: int) -> None:
    _, required, names = ROWS[row]
    assert required and names
    for name in names:
        path, _, function = name.partition("::")
        assert function in names_in(path), f"row {row}: there is no {name}"
